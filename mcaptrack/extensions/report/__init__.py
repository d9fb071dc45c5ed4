"""The page about logs: scores, tracks, identity switches, forecasts, the lineage of results."""
