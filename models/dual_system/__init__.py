"""The dual system: Algorithm 1 of the paper, and how many scenes run through it at once."""
