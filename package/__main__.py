"""The command line."""


def main() -> None:
    """Run the command line."""
    raise SystemExit("servotrack: no commands yet")


if __name__ == "__main__":
    main()
