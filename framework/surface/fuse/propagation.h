// Labels of training pixels spread over the surface that depth shows: by diffusion between cells, or by pooling.
#pragma once

#include <functional>

#include "session/settings/run_config.h"
#include "surface/fuse/fusion.h"

namespace semfield {

/// Edge of a cell that PropagationParams::cell_m leaves open: three pixels at the scene's middle depth, at least 1/500
/// of the bounds' longest side. 0 where the scene states neither.
double default_cell_m(const LoadedScene& scene);

/// How far the work is: classes solved (surface), or sizes of cells pooled (vote), of all.
using PropagationProgress = std::function<void(int done, int of)>;

/// New labels, soft, of every frame of `maps`; one step is added to `labels`' own, with the facts of what was done.
///
/// `surface`: pixels with depth fall into cells of edge cell_m. A cell has the mean colour and the mean normal of its
/// pixels and the sum of their labels, probabilities where labels are soft. Cells that touch are joined with the weight
/// exp(-|dc|^2 / (2 color_sigma^2)) exp(-|dn|^2 / (2 normal_sigma^2)), at least 1e-4, and diffuse_votes spreads the
/// votes. Every pixel of a cell that a vote reaches takes the cell's distribution.
///
/// `vote`: every labelled pixel with depth takes the fractions of the votes in its cell of the first edge of
/// vote_cells_m that holds least_votes, else of the last one. Other pixels stay void.
///
/// A labelled pixel without depth keeps its label. A pixel whose largest probability is below min_confidence becomes
/// void. class_pixels of the result is empty. The bits do not depend on threads. `done` may be null. Throws Error(data)
/// when no frame has labels or no pixel has depth, Error(config) where cell_m is open and the scene has no size.
TrainingLabels propagate_labels(const LoadedScene& scene, const TrainingLabels& labels, const FrameMaps& maps,
                                const PropagationParams& params, const PropagationProgress& done);

}  // namespace semfield
