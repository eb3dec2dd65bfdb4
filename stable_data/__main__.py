"""``python -m stable_data`` is ``stable-data``."""

from stable_data.cli import app

if __name__ == "__main__":
    app()
