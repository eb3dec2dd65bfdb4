"""Readers of assets in the folders and formats in which their authors ship them."""
