"""Assets: their geometry, catalogues, and retrieval."""
