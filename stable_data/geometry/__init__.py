"""Triangle meshes: reading, repair, measures, samples, convex parts."""
