// Colour loss: squared error over rays and channels.
#pragma once

#include "core/view.h"

namespace semfield {

/// L_p = sum of (c - target)^2 / normaliser [Zhi21 Eq. 4]; the mean takes normaliser = 3 * rays of the whole batch, of
/// which these R rays may be one tile. Returns the sum of squares before division, so that tiles add up; writes d_color
/// = scale * 2 (c - target) / normaliser when d_color is not empty. color, target, d_color [R, 3]. Zero rays: 0. A
/// non-finite colour or target makes the sum non-finite (the caller's check names it); nothing is clamped.
template <class Real>
double photometric_loss(View<const Real> color, View<const float> target, double normaliser, double scale,
                        View<Real> d_color);

}  // namespace semfield
