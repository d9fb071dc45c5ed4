"""Players, stills, tables and pages for notebooks, as HTML that needs no other file."""
