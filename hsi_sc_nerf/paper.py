"""Constants of the paper (HSI-SC-NeRF, arXiv 2602.16950) and of its released settings, each with its source.

Options elsewhere take their defaults from here, so that a value that departs from the paper is a visible choice.
"""

# Dataset acquisition (section "Imaging setup").
BANDS = 204
INTEGRATION_TIME_MS = 10.0
WAVELENGTH_RANGE_NM = (397.32, 1003.58)
CONTAINER_DIAMETER_M = 0.09
CONTAINER_HEIGHT_M = 0.07
CONTAINER_MARKERS = 6
DISC_MARKERS = 8

# White-reference calibration (Algorithm 1).
WHITE_PERCENTILE = 70.0  # caption of the calibration figure
REFLECTANCE_BOUNDS = (0.0, 1.0)
# Released settings: morphology ellipse of max(5, min(lines, samples) // 10) pixels, closing before opening.
WHITE_MORPHOLOGY_MIN_PX = 5
WHITE_MORPHOLOGY_FRACTION = 10
WHITE_SMOOTHING_BANDS = 5

# Pseudo-RGB (caption of the apple figure; bands 70, 53 and 19 of the released settings).
PSEUDO_RGB_NM = (598.0, 548.0, 449.0)

# Loss (section "Loss Function"). The printed sum over bands is a mean in the released code, and the weights
# belong to the mean.
ANGULAR_LOSS_WEIGHT = 0.25
HSI_LOSS_WEIGHT = 0.75
DISTORTION_LOSS_WEIGHT = 0.002

# Training protocol (section "Training Protocol").
STAGE_ITERATIONS = (20_000, 20_000)
TRAIN_SPLIT_FRACTION = 0.9

# Released settings of training; what they do not name is nerfacto's own default.
RAYS_PER_BATCH = 4096
NEAR_FAR = (0.01, 5.0)  # of a scene whose cameras lie within [-1, 1]
HASH_LEVELS = 16
LOG2_HASH_TABLE = 19
FINEST_GRID = 2048
LEARNING_RATE = 1e-2
INITIAL_DENSITY = 0.01  # nerfacto as a method; its model's own default, 1, starts in fog that hides the object
# The schedule falls a hundredfold over 200 000 steps, of which each stage makes a tenth: it hardly falls.
LEARNING_RATE_DECAY = 0.01
LEARNING_RATE_DECAY_STEPS = 200_000

# Spatial validation (section "Spatial Validation").
F_SCORE_THRESHOLD_M = 0.002

# Traits (sections "Applications" and "Spectral Validation").
POISSON_DEPTH = 8
CLASSIFICATION_ANGLE_RAD = 0.1
