"""Pages to look at clouds and runs: a viewer in one HTML file, and the index of a run."""
