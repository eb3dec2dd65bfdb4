"""The tuned constants of certification: how stability is judged, where resting poses are sought, what counts as a carrier.

One table for the folder. Lengths are in metres and angles in radians, if nothing else is stated. Tuned on: not recorded, for all
values. A changed value changes which scenes are certified and how.
"""

import numpy as np

# --- static stability: the steadiness of an object is the tangent of the slope at which it would tip
STEADY = 0.1  # from this steadiness on an object stays
FALLS = -0.1  # below this steadiness an object falls; between the two the outcome is not known
STANDS_ALONE = -0.02  # from this steadiness on the bare table an object stands alone
HANGS_BESIDE = -1.0  # below this steadiness an object that stands alone hangs beside its carrier
CONTACT_DISTANCE = 1e-3  # surfaces this near count as contact
FRICTION = 0.5  # coefficient at the contacts; lower than in physics engines, so that the verdict is on the safe side
TEST_SLOPE = 0.1  # tangent of the angle by which the scene is tilted to four sides, to test contacts
FOOT_HEIGHT = 4e-4  # vertices this low belong to the foot of an object that stands alone
ROCKING_SLOPE = 0.035  # so do vertices on a flatter slope from the lowest vertex: the object may rock by about 2 degrees
MAX_CONTACTS = 48  # largest number of contacts for which forces are computed
MAX_RESIDUAL = 0.008  # share of the weight that the contact forces may leave unbalanced
FORCE_PENALTY = 1e-3  # weight of the sum of forces in the least-squares problem
MAX_TOTAL_FORCE = 3.0  # sum of all contact forces, in weights of the object
MIN_CENTRE_HEIGHT = 5e-3  # lower bound of the height of the centre of mass over its contacts

# --- resting poses: the order of candidates and their cost
AIR = 4e-5  # gap below an object at rest: rules without a tolerance, and the exact test itself, take zero distance for a collision
CENTRE_INSETS = (0.02, 0.01, 0.005, 0.0)  # distance of a centre from its carrier's outline; the first that leaves room is used
RING_RADII = (0.004, 0.008, 0.014, 0.022, 0.032, 0.045, 0.06, 0.08, 0.11, 0.15)  # distances of candidates from the start
RING_DIRECTIONS = 8  # candidates on each ring
MIDDLE_SHARES = (0.25, 0.5, 0.75, 1.0)  # candidates on the way to the carrier's middle, shares of that way
CANDIDATE_TURNS = (0.0, np.pi / 2, np.pi / 4, -np.pi / 4)  # yaws of all candidates, from the present one
PLACES_PER_TURN = 60  # largest number of candidates at each yaw
MAX_CANDIDATES = (12, 24, 40, 80)  # candidates tried where the best one is steady, unsure, falls, or there is none yet
RISE_COST = 3.0  # cost of a metre upwards, in metres along the table
UNSTEADY_COST = 100.0  # cost of a pose below STEADY, and again below FALLS: more than any distance
WEDGED_RISE = 4e-3  # an object that ends this much higher may be wedged: the search for a better pose goes on
SLIDE_STEPS = (8e-3, 3e-3, 1e-3)  # step lengths of an object that slides to a lower place
SLIDE_STEPS_EACH = 6  # steps of each length
SLIDE_SLOPE = 0.2  # least slope of such a step: friction holds on a flatter one
SLIDE_DIRECTIONS = 6  # directions of such a step
LEAN_TURNS = tuple(np.radians((0, 20, -20, 45, -45, 90, -90, 135, -135, 180)))  # yaws of a leaning object, from the present one
FOOT_SETBACKS = (0.2, 0.0)  # distance of its foot behind the carrier's middle, shares of the carrier's width
FOOT_OFFSETS = (0.0, 0.15, -0.15)  # distance of its foot to the side, shares of the carrier's width
LEAN_FOOT_HEIGHT = 1e-3  # vertices this low belong to its foot
LEAN_MAX_RISE = 0.03  # an object may be put down at most this much higher than it was

# --- carriers: what supports what in a layout that is not at rest
RIM_DEPTH = 3e-3  # the bottom of a contained object is at least this far below the rim
HOLLOW_GRID = 11  # points a side of the grid at which the depth of a shape is read
HOLLOW_DEPTH = 0.3  # a grid point is deep if it is this far below the top, share of the height
HOLLOW_WALL = 0.25  # and if walls rise this far above it on four sides, share of the height
HOLLOW_SHARE = 0.08  # share of deep grid points from which on a shape is hollow
WALL_LAYERS = 8  # heights at which walls are sought
SUPPORT_SINK = 2e-3  # how far the bottom of an object may be below the bottom of its carrier
SUPPORT_TOUCH = 3e-3  # an object is on another one if it touches that when lowered by this
SUPPORT_GAP = 1e-2  # largest gap between an object and its carrier
OVERHANG = 0.02  # largest distance of an object's centre beyond its carrier's outline
OVERHANG_SHARE = 0.7  # the same as a share of half the object's width; the larger of the two holds
CONTAINER_COVER = 0.8  # least share of an object's outline that is over its container
TOUCH_DEPTH = 0.015  # how far below the top of a carrier the bottom of an object that penetrates it may be
TOUCH_DEPTH_SHARE = 0.5  # the same as a share of the carrier's height; the larger of the two holds
LEAN_DISTANCE = 0.06  # an object that cannot stand alone belongs into a container this near
TABLE_COST = 0.01  # cost of the table as the carrier of an object that is above it
LYING_TABLE_COST = 0.03  # the same for an object that cannot stand alone
TOUCHED_COST = 5e-3  # cost of a carrier that the object touches, but on which it would not stay
WIDTH_COST = 0.05  # cost of a metre of a carrier's width: of two containers around an object the smaller one is likelier
APPROACH_SHARES = (0.0, 0.5, 1.0)  # places at which an object is lowered, shares of the way to the carrier's middle
APPROACH_COST = 0.2  # cost of a metre of that way
