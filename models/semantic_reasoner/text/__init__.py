"""The words and tokens that a language model reads and writes."""
