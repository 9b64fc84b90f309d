"""The entry point of the command `mbkit` and of ``python -m mbkit``; it listens to Ctrl-C before other imports."""

from mbkit import _process as _interrupt


def main() -> None:
    """Run the command."""
    with _interrupt.ending:
        from mbkit.cli import main as command

        command()


if __name__ == "__main__":
    main()
