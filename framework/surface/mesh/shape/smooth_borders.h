// Smooth borders between the classes and objects of a surface.
#pragma once

#include "surface/mesh/surface.h"

namespace semfield {

/// What a vertex is, class and object together, is averaged over the vertices around it, of which the surer count more;
/// it then is what most of that mean says. A triangle whose corners differ is cut where the means of two corners weigh
/// the same along its edges, as marching cubes cuts a cell [Lorensen87]: borders no longer run in steps of triangles.
///
/// All corners of a triangle are one thing afterwards. Where two meet there are two vertices at one place, one of each,
/// as attributes need that change at once; whoever merges vertices by their places has the surface closed again.
/// Vertices that were there keep their numbers. Nothing changes without labels and objects.
void smooth_borders(Surface& surface);

}  // namespace semfield
