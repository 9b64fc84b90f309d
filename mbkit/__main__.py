"""``python -m mbkit``: the same door as the command ``mbkit``."""

from mbkit.cli import main

if __name__ == "__main__":
    main()
