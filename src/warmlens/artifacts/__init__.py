"""HDF5 artifacts: how a file is written, named and trusted."""
