"""Arrays shipped with the package: the embedded body."""
