"""Zones and lines: who visits them, who crosses them, and a page to draw them on."""
