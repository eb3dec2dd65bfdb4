"""The reach job: what a robot reaches and holds in the scenes of a run."""
