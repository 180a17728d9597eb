// The degradations of training labels, one source file each; docs/guide/label_experiments.md tells their rules.
#pragma once

#include <memory>

#include "labels/label_steps.h"

namespace semfield {

/// Uniform random classes on an exact number of pixels per frame [Zhi21, section 4.3].
std::unique_ptr<Degradation> make_pixel_noise();
/// Wrong classes on whole instances in a share of the frames that see them [Zhi21, section 4.3].
std::unique_ptr<Degradation> make_region_noise();
/// Labels known on a coarse grid only [Zhi21, section 4.4].
std::unique_ptr<Degradation> make_super_resolution();
/// One click, or one grown region, a class and frame [Zhi21, section 4.5].
std::unique_ptr<Degradation> make_propagation();
/// Soft or hard labels with the errors of a network, made from clean ones by an error model; no network is asked.
std::unique_ptr<Degradation> make_simulated_predictions();

}  // namespace semfield
