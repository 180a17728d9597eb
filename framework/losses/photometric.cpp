// Squared colour error and its gradient.
#include "losses/photometric.h"

#include "core/check.h"

namespace semfield {

template <class Real>
double photometric_loss(View<const Real> color, View<const float> target, double normaliser, double scale,
                        View<Real> d_color) {
  SEMFIELD_CHECK(color.rows == target.rows, "colours and targets differ in rows");
  SEMFIELD_CHECK(d_color.empty() || normaliser > 0, "the colour loss of a batch needs a positive normaliser");
  const double slope = d_color.empty() ? 0.0 : 2.0 * scale / normaliser;
  double sum = 0;
  for (std::int64_t r = 0; r < color.rows; ++r) {
    for (std::int32_t c = 0; c < 3; ++c) {
      const double error = static_cast<double>(color(r, c)) - static_cast<double>(target(r, c));
      sum += error * error;
      if (!d_color.empty()) d_color(r, c) = static_cast<Real>(slope * error);
    }
  }
  return sum;
}

template double photometric_loss<float>(View<const float>, View<const float>, double, double, View<float>);
template double photometric_loss<double>(View<const double>, View<const float>, double, double, View<double>);

}  // namespace semfield
