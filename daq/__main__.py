"""`python -m daq` is `rotorscope`."""

from daq.commands.entry import main

if __name__ == "__main__":
    main()
