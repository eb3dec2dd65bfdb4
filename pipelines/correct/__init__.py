"""Job correct: scenes become exactly clean scenes."""
