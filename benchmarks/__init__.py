"""Side-by-side figures against peers, measured in one run: ``python -m benchmarks --data DIR --out DIR``."""
