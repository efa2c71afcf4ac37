"""A campaign as a whole: its stages and files, starting it, how far it is."""
