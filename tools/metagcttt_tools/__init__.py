"""The programs behind the command `metagcttt`."""
