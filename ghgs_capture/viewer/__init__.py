"""A page in the browser to look around in a prediction; needs the extra ``viewer``."""
