"""Making data: people, rigs of cameras, photographs, miniatures of data sets."""
