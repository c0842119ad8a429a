"""Where the work of a build is done, and where its results lie."""
