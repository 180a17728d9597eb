// What COLMAP found of the same point in several photographs, as tracks.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "scene/bundle.h"

namespace semfield {

/// Reads features and the matches that two views confirm from a database of COLMAP, and joins matches to tracks: of two
/// that would bring two features of one image into a track, the later is dropped. `names` are those of the images;
/// Sighting::frame is a place among them. Deterministic. Points are not set.
std::vector<Track> feature_tracks(const std::string& database, const std::vector<std::string>& names);

}  // namespace semfield
