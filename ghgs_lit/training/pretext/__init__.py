"""The pretext stage: training of semantic features to tell which body part a patch shows."""
