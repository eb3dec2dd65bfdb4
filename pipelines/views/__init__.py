"""The views job: pictures of the scenes of a run and their features."""
