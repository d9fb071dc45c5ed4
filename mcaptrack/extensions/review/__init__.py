"""A second look: the questions about identities whose answers would change most, to a person or to a judge."""
