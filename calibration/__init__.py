"""Camera, extrinsic and rig calibration: dated result files with residuals."""
