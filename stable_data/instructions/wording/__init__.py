"""Words of instructions, independent of a scene: singular and plural, nouns of categories, paraphrases."""
