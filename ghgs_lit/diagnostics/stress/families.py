"""What is adverse about the inputs of a case: the columns of the matrix of the stress test."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Family:
    """Inputs of one kind: which ingredient they change (None: any stage has them), and how."""

    ingredient: str | None
    says: str


FAMILIES = {
    "ordinary": Family(None, "values as in training"),
    "nan": Family(None, "one NaN in one input"),
    "inf": Family(None, "one infinity in one input"),
    "shifted": Family("cameras", "the world's origin is 1e4 m away"),
    "large": Family("cameras", "a scene in millimetres, or of 1000 times the size"),
    "small": Family("cameras", "a scene in kilometres"),
    "wide": Family("cameras", "focal lengths of a fisheye, 0.1 of the image"),
    "long": Family("cameras", "focal lengths of 1e5 px, the camera as far away"),
    "skewed": Family("cameras", "rotations that are orthogonal to 1e-3 only"),
    "mirrored": Family("cameras", "extrinsics with a determinant of -1"),
    "degenerate": Family("cameras", "rotations of rank 2"),
    "zero_depth": Family("depths", "depths of 0"),
    "negative_depth": Family("depths", "depths below 0"),
    "near_zero_depth": Family("depths", "depths of 1e-12"),
    "huge_depth": Family("depths", "depths of 1e12"),
    "equal_depths": Family("depths", "all depths equal"),
    "behind": Family("points", "points behind the camera"),
    "on_camera": Family("points", "points 1e-6 from the camera's centre"),
    "beside": Family("points", "points beside the frame, whose splats reach into it"),
    "far": Family("points", "points 1e6 m away"),
    "duplicates": Family("points", "all points twice"),
    "collapsed": Family("points", "all points at one place"),
    "few": Family("neighbors", "fewer points than k"),
    "single": Family("neighbors", "one point"),
    "masked": Family("neighbors", "all neighbours but one are masked"),
    "zero_quaternion": Family("quaternions", "quaternions of 0"),
    "tiny_quaternion": Family("quaternions", "quaternions of length 1e-20"),
    "huge_quaternion": Family("quaternions", "quaternions of length 1e20"),
    "zero_scale": Family("scales", "scales of 0"),
    "tiny_scale": Family("scales", "scales of 1e-12"),
    "huge_scale": Family("scales", "scales of 1e4 m"),
    "thin": Family("scales", "scales with an aspect of 1e6"),
    "transparent": Family("opacities", "opacities of 0"),
    "opaque": Family("opacities", "opacities of 1"),
    "stacked": Family("opacities", "thousands of splats on one line of sight"),
    "zero_features": Family("features", "features of 0"),
    "tiny_features": Family("features", "features of length 1e-20"),
    "huge_features": Family("features", "features of length 1e18"),
    "parallel_features": Family("features", "all features equal"),
    "opposite_features": Family("features", "pairs of opposite features"),
    "saturated": Family("raw values", "raw values of +-100"),
    "extreme": Family("raw values", "raw values of +-1e4"),
    "constant": Family("images", "images of one colour"),
    "black": Family("images", "black images"),
    "identical": Family("images", "image and target are equal"),
    "out_of_range": Family("images", "colours from -10 to 10"),
    "empty_mask": Family("masks", "a view without the subject"),
    "one_pixel": Family("masks", "a mask of one pixel"),
    "noise_mask": Family("masks", "a mask of noise"),
    "wrong_mask": Family("masks", "one mask half cut off"),
    "kicked": Family("weights", "after a step of a learning rate of 10"),
}

#: Families whose values are not finite: they are reported or contained, not compared.
PLANTED = {"nan": float("nan"), "inf": float("inf")}
