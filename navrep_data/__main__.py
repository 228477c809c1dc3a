"""``python -m navrep_data``."""

from navrep_data.cli.entry import run

if __name__ == "__main__":
    run()
