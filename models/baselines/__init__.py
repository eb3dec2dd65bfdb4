"""Post-hoc optimisers that the paper compares its corrector with, behind one interface (`outcome.Method`, `methods.METHODS`)."""
