"""The Semantic Reasoner: from an instruction and a table to the objects of O^t, O^B and O^b, stage by stage."""
