"""The job correct: scenes become exactly clean scenes."""
