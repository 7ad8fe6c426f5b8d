"""Making data: people, rigs of cameras, photographs, scans."""
