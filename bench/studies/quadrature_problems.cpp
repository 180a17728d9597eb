#include "studies/quadrature_problems.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

namespace semfield {

namespace {

// Densities and colours, for double and Exact alike.
struct ConstantDensity {
  double value;
  template <class T>
  T sigma(T, T) const {
    return T(value);
  }
  template <class T>
  T slope(T, T) const {
    return T(0);
  }
  template <class T>
  T depth(T t, T) const {
    return T(value) * t;
  }
  std::vector<Exact> jumps(Exact) const { return {}; }
};

struct LinearDensity {
  template <class T>
  T sigma(T t, T) const {
    return t;
  }
  template <class T>
  T slope(T, T) const {
    return T(1);
  }
  template <class T>
  T depth(T t, T) const {
    return t * t / 2;
  }
  std::vector<Exact> jumps(Exact) const { return {}; }
};

struct DecayingDensity {
  template <class T>
  T sigma(T t, T) const {
    return std::exp(-t);
  }
  template <class T>
  T slope(T t, T) const {
    return -std::exp(-t);
  }
  template <class T>
  T depth(T t, T) const {
    return -std::expm1(-t);
  }
  std::vector<Exact> jumps(Exact) const { return {}; }
};

struct Slab {
  double begin, end, sigma;
};

// Vacuum with slabs, all of them moved by the shift.
struct SlabDensity {
  std::vector<Slab> slabs;
  template <class T>
  T sigma(T t, T shift) const {
    for (const Slab& s : slabs) {
      if (t >= T(s.begin) + shift && t < T(s.end) + shift) return T(s.sigma);
    }
    return T(0);
  }
  template <class T>
  T slope(T, T) const {
    return T(0);
  }
  template <class T>
  T depth(T t, T shift) const {
    T sum = 0;
    for (const Slab& s : slabs) {
      const T begin = T(s.begin) + shift, end = T(s.end) + shift;
      if (t > begin) sum += T(s.sigma) * (std::min(t, end) - begin);
    }
    return sum;
  }
  std::vector<Exact> jumps(Exact shift) const {
    std::vector<Exact> out;
    for (const Slab& s : slabs) {
      out.push_back(Exact(s.begin) + shift);
      if (std::isfinite(s.end)) out.push_back(Exact(s.end) + shift);
    }
    return out;
  }
};

struct OneColor {
  template <class T>
  T value(T) const {
    return T(1);
  }
  template <class T>
  T slope(T) const {
    return T(0);
  }
};

struct QuarterColor {
  template <class T>
  T value(T t) const {
    return t / 4;
  }
  template <class T>
  T slope(T) const {
    return T(0.25);
  }
};

struct CosineColor {
  template <class T>
  T value(T t) const {
    return std::cos(t);
  }
  template <class T>
  T slope(T t) const {
    return -std::sin(t);
  }
};

template <class Density, class Color>
class FieldOf final : public RayField {
 public:
  explicit FieldOf(Density density) : density_(std::move(density)) {}
  void evaluate(std::span<const double> t, double shift, double* sigma, double* color, double* logits) const override {
    for (std::size_t k = 0; k < t.size(); ++k) {
      sigma[k] = density_.sigma(t[k], shift);
      color[k] = color_.value(t[k]);
      const auto s = bench_logits(t[k]);
      std::copy(s.begin(), s.end(), logits + kBenchClasses * k);
    }
  }
  Exact sigma(Exact t, Exact shift) const override { return density_.sigma(t, shift); }
  Exact sigma_slope(Exact t, Exact shift) const override { return density_.slope(t, shift); }
  Exact color(Exact t) const override { return color_.value(t); }
  Exact color_slope(Exact t) const override { return color_.slope(t); }
  Exact optical_depth(Exact t, Exact shift) const override { return density_.depth(t, shift); }
  std::vector<Exact> jumps(Exact shift) const override { return density_.jumps(shift); }

 private:
  Density density_;
  Color color_;
};

template <class Color, class Density>
std::shared_ptr<const RayField> field_of(Density density) {
  return std::make_shared<FieldOf<Density, Color>>(std::move(density));
}

RayProblem problem(std::string name, std::string key, std::shared_ptr<const RayField> field) {
  RayProblem p;
  p.name = std::move(name);
  p.key = std::move(key);
  p.field = std::move(field);
  return p;
}

RayProblem with_jumps(std::string name, std::string key, double sigma, std::shared_ptr<const RayField> field) {
  RayProblem p = problem(std::move(name), std::move(key), std::move(field));
  p.smooth = false;
  p.stiffness = sigma;
  p.longest_shift = 0.5;  // a multiple of every interval, so that offsets are spread evenly over each
  return p;
}

}  // namespace

std::vector<RayProblem> quadrature_problems() {
  const double inf = std::numeric_limits<double>::infinity();
  return {
      problem("sigma = 1, c = 1", "constant", field_of<OneColor>(ConstantDensity{1})),
      problem("sigma = 1, c = t/4", "linear_colour", field_of<QuarterColor>(ConstantDensity{1})),
      problem("sigma = t, c = 1", "linear_density", field_of<OneColor>(LinearDensity{})),
      problem("sigma = e^-t, c = cos t", "decay_cosine", field_of<CosineColor>(DecayingDensity{})),
      with_jumps("slabs, edges off the grid", "slabs", 5,
                 field_of<QuarterColor>(SlabDensity{{{0.7, 1.3, 5}, {2.1, 3.2, 1}}})),
      with_jumps("wall, sigma = 10^4 from 1.234", "wall", 1e4,
                 field_of<QuarterColor>(SlabDensity{{{1.234, inf, 1e4}}})),
  };
}

RayProblem constant_medium(double sigma) {
  return problem("sigma everywhere, c = t/4", "stiff", field_of<QuarterColor>(ConstantDensity{sigma}));
}

RayProblem thin_slab(double begin_m, double width_m) {
  RayProblem p = with_jumps("thin slab", "thin_slab", 10 / width_m,
                            field_of<OneColor>(SlabDensity{{{begin_m, begin_m + width_m, 10 / width_m}}}));
  p.near_m = 0.1;
  p.far_m = 10;
  p.longest_shift = 0;
  return p;
}

}  // namespace semfield
