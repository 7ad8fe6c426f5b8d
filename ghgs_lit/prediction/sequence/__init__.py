"""Sequences: instants whose prediction starts from that of the last."""
