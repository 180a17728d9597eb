#include "session/settings/objects_params.h"

namespace semfield {

void describe(ParamVisitor& visit, ObjectsParams& p) {
  SEMFIELD_PARAM(visit, p, steps, "steps of learning on points of the surface", {1, 1e6});
  SEMFIELD_PARAM(visit, p, views, "views of a step", {1, 256});
  SEMFIELD_PARAM(visit, p, view_points, "points of each view of a step", {4, 65536});
  SEMFIELD_PARAM(visit, p, learning_rate, "at the first step; it falls to a hundredth along half a cosine", {1e-6, 1});
  SEMFIELD_PARAM(visit, p, frequencies,
                 "octaves of sines of a position that the network reads, the lowest as long as the scene", {0, 16});
  SEMFIELD_PARAM(visit, p, hidden_width, "units of a hidden layer", {4, 512});
  SEMFIELD_PARAM(visit, p, hidden_layers, "hidden layers of the network", {1, 8});
  SEMFIELD_PARAM(visit, p, rays, "rays of all training views together that look for the surface", {1000, 1e9});
  SEMFIELD_PARAM(visit, p, points, "points that stand for the surface, about; cells are sized for it", {100, 1e7});
  SEMFIELD_PARAM(visit, p, reach, "distance within which segments are of one object, in the units of the method",
                 {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, neighbours, "segments within reach that make a segment the inside of a cluster", {1, 1e6});
  SEMFIELD_PARAM(visit, p, agree,
                 "share of the sights of two groups of points in one segment from which they are one object", {0, 1});
  SEMFIELD_PARAM(visit, p, least_views, "views that see two groups, from which their segments decide", {1, 1e6});
  SEMFIELD_PARAM(visit, p, least_points, "points of an object; what is smaller is none", {1, 1e9});
  SEMFIELD_PARAM(visit, p, stuff, "names of classes that have no objects");
  SEMFIELD_PARAM(visit, p, seed, "seed of every random value of this phase");
}

void describe(ParamVisitor& visit, SegmentDamage& p) {
  SEMFIELD_PARAM(visit, p, shuffle, "segments of an image get new numbers in random order");
  SEMFIELD_PARAM(visit, p, split, "share of an image's segments that a random line cuts in two", {0, 1});
  SEMFIELD_PARAM(visit, p, merge, "share of an image's segments that are joined with a random neighbour", {0, 1});
  SEMFIELD_PARAM(visit, p, missing, "share of an image's segments that are left out", {0, 1});
  SEMFIELD_PARAM(visit, p, border_px, "borders of segments move by up to so many pixels, in patches of 16", {0, 64});
}

}  // namespace semfield
