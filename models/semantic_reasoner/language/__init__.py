"""Reading of instructions: nouns, phrases, required objects, relations."""
