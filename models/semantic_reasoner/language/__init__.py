"""Analysis of instructions: nouns, noun phrases, required objects, stated relations."""
