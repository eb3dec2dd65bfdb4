"""What an asset of a source becomes: its licence, name, scale, poses, mass and colliders, as rows of tables."""

from stable_data.importers.conversion.asset import (
    PERMISSIVE,
    ConversionContext,
    ConversionSettings,
    ConvertedAsset,
    Progress,
    convert,
    extents_of,
)
from stable_data.importers.conversion.sizes import SetScale

__all__ = [
    "PERMISSIVE",
    "ConversionContext",
    "ConversionSettings",
    "ConvertedAsset",
    "Progress",
    "SetScale",
    "convert",
    "extents_of",
]
