"""Queries of logs in SQL, by DuckDB."""
