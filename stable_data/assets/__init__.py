"""Assets: their geometry, catalogues of them, and the search for one that fits."""
