"""The layouts of other systems as coroutines like Algorithm 1: Holodeck-Table, I-Design-Table, and layouts that are read from files."""
