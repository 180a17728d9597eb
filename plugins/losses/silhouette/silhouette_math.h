// The formula of the silhouette loss, for CPU and GPU.
#pragma once

#include "core/host_device.h"
#include "plugin/loss.h"

namespace semfield {

/// (O - a)^2 and its slope for every weight of the ray. Before a background b that is drawn anew for each ray and
/// channel, uniform in [0, 1], with the same b behind the photograph, the expected squared error of colour is that
/// before grey plus (O - a)^2 / 12; random backgrounds are the habit of [Mueller22].
SEMFIELD_HD inline LossValue silhouette_share(double opacity, double alpha) {
  const double error = opacity - alpha;
  return {error * error, 2 * error};
}

}  // namespace semfield
