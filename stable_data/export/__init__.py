"""Foreign formats: one module each, one ``write`` each."""
