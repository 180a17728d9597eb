// Wide channels of a dataset, learned by their principal axes: found once, kept with the network, and applied to the
// training frames.
#pragma once

#include <string>
#include <vector>

#include "core/view.h"
#include "scene/stored_frame.h"

namespace semfield {

struct Session;

/// The `width` directions that keep most of the rows' dot products: eigenvectors of the mean of f f^T over rows f of
/// unit length, largest first, about the origin and not about the mean, so that angles stay what they were. Returns
/// [cols, width] with orthonormal columns, whose largest element is positive. At most 65,536 cells are looked at,
/// evenly spaced. Throws Error(data) where no frame has a row that is not zero.
std::vector<float> principal_axes(const std::vector<const FrameChannel*>& maps, std::int32_t width);
/// The rows of `map` become their coordinates: row times matrix [map.cols, width].
void multiply_rows(FrameChannel& map, View<const float> matrix);

/// Finds the axes of the heads that learn fewer columns than their channel has, puts them into the network's state and
/// the channels of the training frames onto them. False where no head has any.
bool settle_axes(Session& session);
/// After a checkpoint has replaced the state: the frames' channels, which lie on the axes `before` in the order of the
/// session's heads, go onto those of the checkpoint.
void follow_axes(Session& session, const std::vector<std::vector<float>>& before);
/// The axes in the network's state, one for each head of the session; empty for heads that have none.
std::vector<std::vector<float>> axes_of(const Session& session);

}  // namespace semfield
