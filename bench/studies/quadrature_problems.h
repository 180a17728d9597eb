// Analytic media along a ray: fields in closed form, their rendering integrals to twice the digits of double, and the
// errors that theory predicts for each rule of the rendering integral.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

namespace semfield {

/// References are computed in it: 64 binary digits where the CPU has them.
using Exact = long double;

constexpr int kBenchClasses = 3;
/// Logits of every medium, s(t).
template <class T>
std::array<T, kBenchClasses> bench_logits(T t) {
  return {3 * std::sin(t), 3 * std::cos(t / 2), T(1)};
}

/// What a ray shows: colour (one channel), opacity, expected depth in metres, probability of class 0.
constexpr int kQuantities = 4;
enum class Quantity : std::uint8_t { color, opacity, depth, probability };
constexpr std::array<const char*, kQuantities> kQuantityNames{"colour", "opacity", "depth", "class probability"};

/// Values of one ray, or constants or orders for each of its quantities.
using PerQuantity = std::array<Exact, kQuantities>;

/// A medium and what it shows. `shift` moves the jumps of media that have some, so that many rays meet a grid of
/// samples at every offset; the others ignore it.
class RayField {
 public:
  virtual ~RayField() = default;
  /// sigma [n] in 1/m, color [n], logits [n * kBenchClasses] at distances t [n].
  virtual void evaluate(std::span<const double> t, double shift, double* sigma, double* color,
                        double* logits) const = 0;
  virtual Exact sigma(Exact t, Exact shift) const = 0;
  virtual Exact sigma_slope(Exact t, Exact shift) const = 0;
  virtual Exact color(Exact t) const = 0;
  virtual Exact color_slope(Exact t) const = 0;
  /// Integral of sigma from 0 to t.
  virtual Exact optical_depth(Exact t, Exact shift) const = 0;
  /// Where sigma jumps, ascending.
  virtual std::vector<Exact> jumps(Exact shift) const = 0;
};

struct RayProblem {
  std::string name;  ///< "e^-t, cos t"
  std::string key;   ///< file name: "decay_cosine"
  bool smooth = true;
  double near_m = 0, far_m = 4;
  double stiffness = 0;      ///< largest sigma of a medium with jumps, 1/m
  double longest_shift = 0;  ///< shifts are spread over [0, this)
  std::shared_ptr<const RayField> field;
};

/// sigma = 1, c = 1; sigma = 1, c = t/4; sigma = t; sigma = e^-t, c = cos t; slabs with edges off the grid; an opaque
/// wall at 1.234 m.
std::vector<RayProblem> quadrature_problems();
/// sigma everywhere, c = t/4, on [0, 4].
RayProblem constant_medium(double sigma);
/// One slab of `width_m` and optical depth 10 that begins at begin_m, on [0.1, 10], c = 1.
RayProblem thin_slab(double begin_m, double width_m);

/// The integrals of a ray: relative error about 1e-17. Colour behind the far end is black.
PerQuantity exact_values(const RayProblem& problem, double shift);

/// softmax(logits)[0].
Exact class_probability(std::span<const Exact> logits);

/// Where a rule takes its samples; docs/reference/quadrature.md derives what follows for each.
enum class RuleShape : std::uint8_t {
  left,             ///< the near end of equal intervals
  paper_training,   ///< jittered points, each at the near end of the interval to the next
  paper_rendering,  ///< the same with the jitter at its mean
  midpoint,
  bin_training,  ///< jittered points, each for its bin
  second,        ///< order 2, constant not derived
  fourth,        ///< order 4, constant not derived
};

/// What theory says of a rule in a medium, for the interval h = length / N. Without terms only the order is known.
struct Prediction {
  double order = 0;  ///< as h goes to 0
  /// mean error = bias1 h + bias2 h^2; variance over rays = variance2 h^2 + variance3 h^3.
  struct Terms {
    double bias1 = 0, bias2 = 0, variance2 = 0, variance3 = 0;
  };
  std::optional<Terms> terms = {};

  bool exact() const;                 ///< every term is 0
  double rms(double interval) const;  ///< needs terms
};

/// For a smooth medium: as derived from d(error) = int T (v - R) d(sigma) + sigma T dv. For one with jumps: order 1
/// without a constant, or 0 for `fourth` where the medium is opaque within an interval.
Prediction predict(const RayProblem& problem, RuleShape shape, Quantity quantity);

}  // namespace semfield
