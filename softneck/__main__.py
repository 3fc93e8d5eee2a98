"""`python -m softneck` is the command `softneck`."""

from softneck.cli import main

if __name__ == "__main__":
    main()
