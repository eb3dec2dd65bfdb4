"""The rate job: ratings of the scenes of a run by the paper's five criteria."""
