"""``python -m mcaptrack``."""

from mcaptrack.cli import main

if __name__ == "__main__":
    main()
