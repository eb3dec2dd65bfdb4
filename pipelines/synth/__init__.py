"""Job synth: the embedded world, made by many workers."""
