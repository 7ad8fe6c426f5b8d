"""Synthesis of data: people, rigs of cameras, photographs, scans."""
