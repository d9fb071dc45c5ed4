"""Ask a person or a judge about the identities that re-tracking is least sure of, and obey the answers."""
