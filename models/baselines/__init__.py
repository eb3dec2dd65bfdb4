"""Other systems that the paper compares its own with, re-implemented from their descriptions.

Post-hoc optimisers are behind one interface (``outcome.Baseline``, ``methods.METHODS``); ``post_processing`` lets one take the place of the
Physics Corrector. ``layout`` contains systems that lay out scenes, ``placement`` their searches. ``systems`` names the settings of the
job ``generate`` for each row of the paper's comparison.
"""
