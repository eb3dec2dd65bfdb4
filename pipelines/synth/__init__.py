"""The job synth: many workers write scenes of the embedded world."""
