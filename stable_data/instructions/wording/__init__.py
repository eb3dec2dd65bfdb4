"""The words of instructions: one and many, what things are called, paraphrases. Nothing here knows a scene."""
