"""What is learned: point encoder, Physics Corrector, Semantic Reasoner."""

import os

# Torch keeps the kernels of each shape of a product, 0.5 MB for each length of a prompt, in two caches of 1,024 entries. A smaller bound
# costs no time. Both read it when they are first used.
for _name in ("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "LRU_CACHE_CAPACITY"):
    os.environ.setdefault(_name, "128")
