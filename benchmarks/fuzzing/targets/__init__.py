"""The readers that are fuzzed, with the honest files that are changed for them."""
