"""The evaluation of systems on the same tasks: the paper's Table 1, and more columns."""
