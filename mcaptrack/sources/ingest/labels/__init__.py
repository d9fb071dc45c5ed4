"""Label files: their formats, their rows, and the pictures that they belong to."""
