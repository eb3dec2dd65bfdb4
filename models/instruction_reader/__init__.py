"""Reads an instruction in free words: the objects that it mentions, what it states of the start, and its goal."""
