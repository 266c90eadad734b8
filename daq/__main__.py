"""`python -m daq` is `rotorscope`."""

from .entry import main

if __name__ == "__main__":
    main()
