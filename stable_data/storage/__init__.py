"""Runs as folders of Parquet files: schemas, rows, queries, and loading for training."""
