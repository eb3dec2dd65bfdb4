"""Runs as folders of Parquet files: schemas, rows, filter expressions, and loading for training."""
