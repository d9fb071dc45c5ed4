"""What comes in: videos, logs, messages of other software, labels, drawn scenes; and what belongs to which camera."""
