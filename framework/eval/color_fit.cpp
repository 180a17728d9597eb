#include "eval/color_fit.h"

#include <Eigen/Dense>
#include <algorithm>

#include "core/check.h"

namespace semfield {

namespace {

using Colors = Eigen::Matrix<double, 4, 3>;

// A weak pull towards the identity, for halves of one colour.
constexpr double kPull = 1e-3;

struct Fit {
  Eigen::Matrix4d square = Eigen::Matrix4d::Zero();
  Colors right = Colors::Zero();

  void add(const float* truth, const float* predicted) {
    Eigen::Vector4d from(double{predicted[0]}, double{predicted[1]}, double{predicted[2]}, 1);
    const Eigen::RowVector3d to(double{truth[0]}, double{truth[1]}, double{truth[2]});
    if (!from.allFinite() || !to.allFinite()) return;
    square += from * from.transpose();
    right += from * to;
  }
  Colors solve() const {
    const double pull = kPull * std::max(1.0, square(3, 3));
    Colors identity = Colors::Zero();
    identity.topRows<3>().setIdentity();
    const Eigen::Matrix4d damped = square + pull * Eigen::Matrix4d::Identity();
    return damped.ldlt().solve(right + pull * identity);
  }
};

}  // namespace

std::vector<float> fitted_by_halves(std::span<const float> truth, std::span<const float> predicted,
                                    std::int32_t width_px, std::span<const std::uint8_t> used) {
  SEMFIELD_CHECK(truth.size() == predicted.size(), "truth and prediction have one length");
  const std::size_t pixels = predicted.size() / 3, width = static_cast<std::size_t>(width_px);
  const auto half_of = [&](std::size_t pixel) { return pixel % width < width / 2 ? 0 : 1; };
  Fit fits[2];
  for (std::size_t p = 0; p < pixels; ++p) {
    if (used.empty() || used[p] != 0) fits[half_of(p)].add(&truth[3 * p], &predicted[3 * p]);
  }
  const Colors maps[2] = {fits[1].solve(), fits[0].solve()};  // of the other half
  std::vector<float> out(predicted.size());
  for (std::size_t p = 0; p < pixels; ++p) {
    const float* const color = &predicted[3 * p];
    const Eigen::RowVector4d from(double{color[0]}, double{color[1]}, double{color[2]}, 1);
    const Eigen::RowVector3d to = from * maps[half_of(p)];
    for (int i = 0; i < 3; ++i) out[3 * p + static_cast<std::size_t>(i)] = static_cast<float>(to[i]);
  }
  return out;
}

}  // namespace semfield
