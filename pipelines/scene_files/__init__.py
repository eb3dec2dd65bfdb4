"""Scene files of other projects: imported into runs, or repaired and written back."""
