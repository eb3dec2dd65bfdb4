"""Scenes in MuJoCo: models, settling, pictures, an environment."""
