"""Runs `python -m metagcttt_tools`, which is `metagcttt`."""

from metagcttt_tools.main import main

main()
