// The analytic room as a dataset of the suite, and small networks on it: whole steps and whole pictures.
#pragma once

#include "plugin/registry.h"
#include "session/session.h"

namespace semfield::numerics {

/// Passes and rendering of two kinds of network; to be put behind "scene: {type: box_room}\n". The hash grid
/// learns its encoding behind an occupancy grid; the frequency kind has the shape of [Zhi21], two passes.
extern const char* const kHashPass;
extern const char* const kFrequencyPass;

/// The analytic room (4 m x 3 m x 2 m) moved by `shift_m`.
std::unique_ptr<Dataset> shifted_room(Vec3d shift_m);

/// `known` and the dataset 'box_room', moved by `shift_m`: 12 frames of 48 x 36 pixels.
Registry with_room(const Registry& known, Vec3d shift_m = {});

/// Reads and opens a configuration, for the CPU unless it names a device. Throws Error with every problem.
Session open_room(const std::string& yaml, Registry& registry);

/// Colours of the first frame before any training.
std::vector<float> render_room_frame(const Registry& known, const std::string& yaml, Vec3d shift_m);

}  // namespace semfield::numerics
