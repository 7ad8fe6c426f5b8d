"""The paper's method: one module or package per stage, and the model (:mod:`ghgs_lit.method.model`)."""
