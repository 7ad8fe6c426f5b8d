"""The pretext stage: semantic features learn what part of a body a patch shows, from built-in people."""
