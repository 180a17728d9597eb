// A surface with fewer triangles.
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

/// Collapses edges, the one of least error first, until at most `faces` triangles are left or no edge can go
/// [Garland97]. The error is the squared distance to the planes of all triangles that a vertex stands for, times their
/// area, and borders have planes that hold them in place. A vertex moves to where the error is least; it keeps colour,
/// class and entropy of the end that it lies nearer to. We differ:
///
/// - borders between classes have planes too, so that a border moved across a face costs what moving the face would;
/// - a collapse that would turn a triangle over, or change how the surface hangs together, is not done. What was closed
///   stays closed.
///
/// Ties go to the smaller numbers of vertices, so results depend on nothing but the surface. Normals are set anew.
void simplify(Surface& surface, std::size_t faces);

}  // namespace semfield
