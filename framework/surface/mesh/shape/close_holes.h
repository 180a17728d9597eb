// Triangles into the holes of a surface.
#pragma once

#include <cstddef>

#include "surface/mesh/surface.h"

namespace semfield {

/// Fills each loop of border edges that is at most `longest` long with the triangles of least area [Barequet95]; no
/// vertex is added, and no edge gets a third triangle. Loops of more than kMostHoleEdges edges stay open, and where
/// borders touch in a vertex the loops are those without a vertex twice. The outer border of an open surface is a loop
/// as any other. Returns how many were closed; normals are set anew if any was.
std::size_t close_holes(Surface& surface, double longest);
inline constexpr std::size_t kMostHoleEdges = 400;

}  // namespace semfield
