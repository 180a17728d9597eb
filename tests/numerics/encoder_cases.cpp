// One level of the hash grid by other means: addresses in 128-bit integers, interpolation in long double.

#include <fmt/format.h>

#include "core/view.h"
#include "plugins/encoders/hash_grid/hash_grid_kernels.h"
#include "ray_bench.h"
#include "rooms.h"
#include "testkit/benches.h"

#if defined(SEMFIELD_HAS_QUADMATH)
#include <quadmath.h>
#endif

namespace semfield::numerics {

using testkit::EncoderBox;
using testkit::make_part;

__extension__ using Wide128 = unsigned __int128;

inline Wide128 vertices_of(std::uint64_t resolution) {
  const Wide128 n = static_cast<Wide128>(resolution) + 1;
  return n * n * n;
}

/// Row of the level's table that holds vertex (x, y, z) of N cells per axis [Mueller22 Eq. 4].
inline std::int64_t reference_entry(std::uint64_t resolution, std::int64_t entries, const std::uint64_t* v) {
  if (vertices_of(resolution) <= static_cast<Wide128>(entries)) {
    const Wide128 n = static_cast<Wide128>(resolution) + 1;
    return static_cast<std::int64_t>(v[0] + n * (v[1] + n * v[2]));
  }
  const Wide128 low = (Wide128{1} << 32) - 1;
  const Wide128 mixed = v[0] ^ (Wide128{v[1]} * 2654435761u & low) ^ (Wide128{v[2]} * 805459861u & low);
  return static_cast<std::int64_t>(mixed % static_cast<Wide128>(entries));
}

/// Feature f at x, clamped to the cube: three nested linear interpolations.
template <class Real>
long double reference_feature(std::uint64_t resolution, View<const Real> table, std::int32_t f, const double* x) {
  std::uint64_t cell[3];
  long double w[3];
  for (int d = 0; d < 3; ++d) {
    const long double p = std::clamp(long_double(x[d]), 0.0L, 1.0L) * long_double(resolution);
    cell[d] = std::min(static_cast<std::uint64_t>(p), resolution - 1);
    w[d] = p - long_double(cell[d]);
  }
  long double sum = 0;
  for (unsigned c = 0; c < 8; ++c) {
    std::uint64_t v[3];
    long double weight = 1;
    for (unsigned d = 0; d < 3; ++d) {
      const unsigned far = c >> d & 1;
      v[d] = cell[d] + far;
      weight *= far != 0 ? w[d] : 1 - w[d];
    }
    sum += weight * long_double(table(reference_entry(resolution, table.rows, v), f));
  }
  return sum;
}

/// Settings of a grid with one level of N cells per axis.
inline testkit::Settings one_level(std::int64_t resolution, int log2_entries, int features = 2,
                                   const std::string& interpolation = "linear") {
  return {{"levels", "1"},
          {"features", std::to_string(features)},
          {"log2_entries", std::to_string(log2_entries)},
          {"base_resolution", std::to_string(resolution)},
          {"finest_resolution", std::to_string(resolution)},
          {"interpolation", interpolation}};
}

// Cases C01 to C07: positional encoding and directions.

namespace {

// The widest floating type at hand for references: 113 bits where the compiler has them, else long double.
#if defined(SEMFIELD_HAS_QUADMATH)
__extension__ using Wide = __float128;
Wide wide_sin(Wide x) { return sinq(x); }
Wide wide_cos(Wide x) { return cosq(x); }
Wide wide_scaled(Wide x, int exponent) { return ldexpq(x, exponent); }
Wide wide_remainder(Wide x, Wide y) { return fmodq(x, y); }
Wide wide_pi() { return 4 * atanq(1); }
#else
using Wide = long double;
Wide wide_sin(Wide x) { return std::sin(x); }
Wide wide_cos(Wide x) { return std::cos(x); }
Wide wide_scaled(Wide x, int exponent) { return std::ldexp(x, exponent); }
Wide wide_remainder(Wide x, Wide y) { return std::fmod(x, y); }
Wide wide_pi() { return 3.14159265358979323846264338327950288L; }
#endif

double distance(Wide a, Wide b) { return static_cast<double>(a > b ? a - b : b - a); }

const char* const kAngulars[] = {"radian", "pi"};

/// Angle of band k in radians, reduced exactly where the factor is pi.
Wide angle(Wide x, int k, const std::string& angular) {
  const Wide scaled = wide_scaled(x, k);
  return angular == "pi" ? wide_remainder(scaled, 2) * wide_pi() : scaled;
}

/// Sines and cosines of `bands` bands of each x, laid out as the encoder lays out one coordinate without its input.
std::vector<Wide> reference_bands(const std::vector<Wide>& x, int bands, const std::string& angular) {
  std::vector<Wide> out;
  out.reserve(x.size() * 2 * static_cast<std::size_t>(bands));
  for (const Wide value : x) {
    for (int k = 0; k < bands; ++k) {
      const Wide phase = angle(value, k, angular);
      out.push_back(wide_sin(phase));
      out.push_back(wide_cos(phase));
    }
  }
  return out;
}

testkit::Settings settings(int bands, const std::string& angular, const std::string& arithmetic = "float64") {
  return {{"frequencies", std::to_string(bands)},
          {"include_input", "false"},
          {"angular", angular},
          {"arithmetic", arithmetic}};
}

std::vector<Wide> widened(const std::vector<double>& x) { return {x.begin(), x.end()}; }

/// The largest error of each band.
template <class Real>
std::vector<double> errors_by_band(const std::vector<Real>& y, const std::vector<Wide>& want, int bands) {
  std::vector<double> worst(static_cast<std::size_t>(bands), 0.0);
  for (std::size_t i = 0; i < y.size(); ++i) {
    double& band = worst[(i / 2) % static_cast<std::size_t>(bands)];
    const double error = distance(static_cast<Wide>(y[i]), want[i]);
    if (!(error <= band)) band = error;
  }
  return worst;
}
double largest(const std::vector<double>& values) { return *std::max_element(values.begin(), values.end()); }

/// Random values of both signs, magnitudes spread evenly over powers of two from 2^low to 2^high, representable in
/// fp32.
std::vector<double> spread(int count, int low, int high, std::uint64_t seed) {
  Numbers numbers(seed);
  std::vector<double> x;
  for (int i = 0; i < count; ++i) {
    const double magnitude = std::exp2(numbers.in(low, high));
    x.push_back(static_cast<double>(static_cast<float>(numbers.uniform() < 0.5 ? magnitude : -magnitude)));
  }
  return x;
}

std::vector<double> uniform(int count, double bound, std::uint64_t seed) {
  Numbers numbers(seed);
  std::vector<double> x;
  for (int i = 0; i < count; ++i) x.push_back(static_cast<double>(static_cast<float>(numbers.in(-bound, bound))));
  return x;
}

template <class Real>
void measure_bands(CaseRun& run, const std::vector<double>& x, int bands) {
  for (const char* angular : kAngulars) {
    EncoderBox<Real> box(run.registry(), "frequency", settings(bands, angular), 1);
    run.measure(largest(errors_by_band(box.forward(x), reference_bands(widened(x), bands, angular), bands)),
                tolerance_of<Real>(1.2e-7), angular);
  }
}

}  // namespace

IN_BOTH_PRECISIONS(pe_ten_bands) {
  std::vector<double> x = uniform(2000, 1, 1);
  for (const double edge : {0.0, 1.0, -1.0, 0.5, 0x1p-30, 0x1p-140}) x.push_back(edge);
  measure_bands<Real>(run, x, 10);
}

IN_BOTH_PRECISIONS(pe_stored_x) {
  std::vector<double> x = uniform(300, 1, 2);
  for (const double v : uniform(300, 10, 3)) x.push_back(v);
  for (const double v : spread(600, -20, 20, 4)) x.push_back(v);
  measure_bands<Real>(run, x, 40);
  // What the exact reduction is for: the angle rounded to fp32, as a plain program has it, on the first 300 x.
  EncoderBox<Real> naive(run.registry(), "frequency", settings(40, "pi", "naive"), 1);
  const std::vector<double> unit(x.begin(), x.begin() + 300);
  const std::vector<double> off = errors_by_band(naive.forward(unit), reference_bands(widened(unit), 40, "pi"), 40);
  run.expect(off[22] > 0.1, "an angle rounded to fp32 loses band 22");
  run.note(fmt::format("'naive' at |x| <= 1: {:.1e} in band 9, {:.2f} in band 22", off[9], off[22]));
}

namespace {

/// One sample on each of 400 rays of a 10 m room, as a pass places it, and where it is exactly.
template <class Real>
struct PlacedSamples {
  std::vector<double> x;  ///< one coordinate per ray
  std::vector<Wide> exact;

  explicit PlacedSamples(const Registry& registry) {
    constexpr std::int32_t kRays = 400;
    ParamStore<Real> store(1, 1, false);
    const Pass<Real> pass(small_pass<Real>(registry), RenderRules{}, store);
    Numbers numbers(5);
    std::vector<double> origin, direction, place(3 * kRays);
    std::vector<Real> t, delta(kRays, Real(1));
    std::vector<std::int32_t> ray, first{0};
    for (std::int32_t r = 0; r < kRays; ++r) {
      for (int d = 0; d < 3; ++d) origin.push_back(numbers.in(-5, 5));
      const double z = numbers.in(-1, 1), phi = numbers.in(0, 6.283185307179586), s = std::sqrt(1 - z * z);
      for (const double v : {s * std::cos(phi), s * std::sin(phi), z}) direction.push_back(v);
      t.push_back(static_cast<Real>(numbers.in(0.05, 5)));
      ray.push_back(r);
      first.push_back(r + 1);
    }
    const Samples<Real> samples{
        {t.data(), kRays, 1}, {delta.data(), kRays, 1}, {ray.data(), kRays, 1}, {first.data(), kRays + 1, 1}, kRays};
    pass.locate(StepContext{}, {{origin.data(), kRays, 3}, {direction.data(), kRays, 3}, {}}, samples,
                {place.data(), kRays, 3});
    const DomainMap& map = pass.parts().domain;
    for (std::size_t r = 0; r < kRays; ++r) {
      const int axis = static_cast<int>(r % 3);
      const std::size_t at = 3 * r + r % 3;
      x.push_back(place[at]);
      exact.push_back((static_cast<Wide>(origin[at]) + static_cast<Wide>(t[r]) * static_cast<Wide>(direction[at]) -
                       static_cast<Wide>(map.center[axis])) *
                          static_cast<Wide>(map.scale) +
                      static_cast<Wide>(map.offset));
    }
  }
};

}  // namespace

void pe_geometry(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const PlacedSamples<Real> placed(run.registry());
    const std::vector<Wide> want = reference_bands(placed.exact, 40, "pi");
    // Half an ulp each of product (up to 5 m), sum (10 m) and scaled coordinate (2), in units of the coordinate.
    const double geometry = 0x1p-53 * ((5 + 10) * 0.2 + 2);
    const double own = tolerance_of<Real>(1.2e-7, 1e-15);
    const double pi = 3.141592653589793;
    for (const bool rounded : {false, true}) {
      EncoderBox<Real> box(run.registry(), "frequency", settings(40, "pi", rounded ? "float32" : "float64"), 1);
      const std::vector<double> off = errors_by_band(box.forward(placed.x), want, 40);
      const double dx = geometry + (rounded ? 0x1p-24 : 0.0);  // half an ulp of fp32 below 2
      int bands = 0;
      for (int k = 0; k < 40; ++k) {
        const double predicted = pi * std::ldexp(dx, k);
        if (predicted < 1) {  // above, the band is noise and says nothing
          run.measure(off[k], predicted + own,
                      fmt::format("band {} of {} coordinates", k, rounded ? "fp32" : "float64"));
        }
        bands += bands == k && off[k] < 0.1 ? 1 : 0;
      }
      run.expect(rounded ? bands >= 18 && bands <= 20 : bands == 40, "bands with less than 0.1 of error");
      run.note(fmt::format("{} coordinates: {} bands below 0.1, band 39 off by {:.1e}", rounded ? "fp32" : "float64",
                           bands, off[39]));
    }
  });
  // A run with more bands than its coordinates carry gets a warning before it starts; one in float64 has none to get.
  run.row("-");
  for (const char* arithmetic : {"float64", "float32", "naive"}) {
    TrainingBox box(run.registry(),
                    fmt::format("scene: {{type: box_room, load: {{downscale: 4}}}}\n"
                                "passes:\n"
                                "  - sampler: {{type: stratified, samples: 4}}\n"
                                "    position: {{type: frequency, frequencies: 40, angular: pi, arithmetic: {}}}\n"
                                "    field: {{type: tiny_mlp, hidden_width: 16, color_width: 16}}\n"
                                "train: {{steps: 10, rays: 8}}\n",
                                arithmetic));
    const std::vector<std::string>& said = box.session().chosen;
    const auto line = std::find_if(said.begin(), said.end(), [](const std::string& text) {
      return text.find("effective_bands is ") != std::string::npos;
    });
    const bool is_double = std::string(arithmetic) == "float64";
    run.expect((line == said.end()) == is_double, "a warning where bands are noise, and there alone");
    if (line == said.end()) continue;
    run.expect(line->find("passes.0.position: warning: ") == 0 && line->find(" of 40") != std::string::npos,
               "it names pass and part, and how many of how many bands count");
    // Bounds fill [-1, 1]; floor(log2(0.1 / (pi dx))) with dx = 2^-24, twice that where factor and product round too.
    const int bands = std::stoi(line->substr(line->find("effective_bands is ") + 19));
    run.near(bands, std::string(arithmetic) == "naive" ? 18 : 19, 0, "bands that count");
  }
}

void pe_gradient(CaseRun& run) {
  const std::vector<double> x = uniform(500, 1, 6);
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const char* angular : kAngulars) {
      EncoderBox<Real> box(run.registry(), "frequency", settings(40, angular), 1);
      const Wide a = std::string(angular) == "pi" ? wide_pi() : static_cast<Wide>(1);
      double steepest = 0;
      for (const int k : {0, 5, 10, 20, 30, 39}) {
        std::vector<Real> dy(x.size() * 80, Real(0));
        for (std::size_t i = 0; i < x.size(); ++i) {
          dy[80 * i + 2 * static_cast<std::size_t>(k)] = Real(1);       // sine
          dy[80 * i + 2 * static_cast<std::size_t>(k) + 1] = Real(-2);  // cosine
        }
        const std::vector<Real> dx = box.backward(x, dy);
        const Wide slope = wide_scaled(a, k);
        for (std::size_t i = 0; i < x.size(); ++i) {
          const Wide phase = angle(static_cast<Wide>(x[i]), k, angular);
          const Wide want = slope * (wide_cos(phase) + 2 * wide_sin(phase));
          run.expect(std::isfinite(dx[i]), "a gradient is finite");
          run.measure(distance(static_cast<Wide>(dx[i]), want) / static_cast<double>(slope), tolerance_of<Real>(1e-6),
                      angular);
          steepest = std::max<double>(steepest, std::abs(dx[i]));
        }
      }
      run.note(fmt::format("{}: largest gradient {:.1e}", angular, steepest));
    }
  });
}

void pe_double_angle(CaseRun& run) {
  run.row("-");
  run.expect_error(ErrorKind::config, {"arithmetic", "double_angle"}, [&] {
    testkit::make_params(run.registry().get(PluginKind::encoder, "frequency"), {{"arithmetic", "double_angle"}});
  });
  run.note("no recurrence is offered; every band is reduced by itself");
  in_both_precisions(run, [&]<class Real>(Real) {
    // A recurrence would double its error from band to band. x in fp32, so float32 and float64 mean the same.
    const std::vector<double> x = uniform(300, 1, 7);
    const std::vector<Wide> want = reference_bands(widened(x), 40, "pi");
    for (const char* arithmetic : {"float64", "float32"}) {
      EncoderBox<Real> box(run.registry(), "frequency", settings(40, "pi", arithmetic), 1);
      for (const double error : errors_by_band(box.forward(x), want, 40))
        run.measure(error, tolerance_of<Real>(1.2e-7), arithmetic);
    }
  });
}

void pe_bad_input(CaseRun& run) {
  const double infinity = std::numeric_limits<double>::infinity();
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const char* arithmetic : {"float64", "float32", "naive"}) {
      EncoderBox<Real> box(run.registry(), "frequency", settings(40, "radian", arithmetic));
      for (const double bad : {std::nan(""), infinity, -infinity, 1e30, -1e30, 0x1p30 * (1 + 0x1p-22)}) {
        for (const std::size_t row : {0u, 63u, 64u, 199u}) {
          std::vector<double> x(600, 0.25);
          x[3 * row + row % 3] = bad;
          run.expect_error(ErrorKind::data, {fmt::format("row {} ", row), "frequency"}, [&] { box.forward(x); });
        }
      }
      const std::vector<double> edge(3, 0x1p30);
      for (const Real y : box.forward(edge)) run.expect(std::abs(y) <= Real(1), "2^30 itself is encoded");
    }
    for (const char* name : {"hash_grid", "identity"}) {
      const bool grid = std::string(name) == "hash_grid";
      EncoderBox<Real> box(run.registry(), name,
                           grid ? testkit::Settings{{"log2_entries", "10"}} : testkit::Settings{});
      for (const double bad : {std::nan(""), infinity, -infinity}) {
        std::vector<double> x(120, 0.25);
        x[3 * 37 + 1] = bad;
        run.expect_error(ErrorKind::data, {"row 37 ", name}, [&] { box.forward(x); });
      }
    }
  });
}

IN_BOTH_PRECISIONS(directions) {
  EncoderBox<Real> box(run.registry(), "spherical_harmonics", {{"degree", "5"}});
  // On the axis z only m = 0 remains: Y_l0 = sqrt((2l + 1) / 4 pi) (+-1)^l.
  const long double pi = 3.14159265358979323846264338327950288L;
  for (const int sign : {1, -1}) {
    const std::vector<Real> y = box.forward({0, 0, static_cast<double>(sign)});
    for (int l = 0; l < 5; ++l) {
      for (int m = -l; m <= l; ++m) {
        const Real value = y[l * l + l + m];
        const long double want = m == 0 ? std::sqrt((2 * l + 1) / (4 * pi)) * (l % 2 == 0 ? 1 : sign) : 0.0L;
        run.relative(value, want, m == 0 ? tolerance_of<Real>(2.4e-7) : 0.0, "on the axis");
      }
    }
  }
  // Addition theorem: for every direction the squares of one l sum to (2l + 1) / 4 pi. It holds on all six axes too.
  Numbers numbers(8);
  std::vector<double> unit{1, 0, 0, -1, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 1, 0, 0, -1};
  for (int i = 0; i < 200; ++i) {
    const double z = numbers.in(-1, 1), phi = numbers.in(0, 6.283185307179586), s = std::sqrt(1 - z * z);
    for (const double v : {s * std::cos(phi), s * std::sin(phi), z}) unit.push_back(v);
  }
  const std::vector<Real> y = box.forward(unit);
  for (std::size_t r = 0; r < unit.size() / 3; ++r) {
    for (std::size_t l = 0; l < 5; ++l) {
      long double squares = 0;
      for (std::size_t i = l * l; i < (l + 1) * (l + 1); ++i)
        squares += long_double(y[25 * r + i]) * long_double(y[25 * r + i]);
      run.relative(squares, long_double(2 * l + 1) / (4 * pi), tolerance_of<Real>(4e-6), "addition theorem");
    }
  }
  const double nan = std::nan("");
  const std::vector<std::vector<double>> bad{
      {0, 0, 0},     {2, 0, 0}, {0.5, 0.5, 0.5}, {nan, 0, 1}, {0, std::numeric_limits<double>::infinity(), 0},
      {1e-200, 0, 0}};
  for (const std::vector<double>& one : bad) {
    std::vector<double> x(3 * 21, 0.0);
    for (std::size_t r = 0; r < 21; ++r) x[3 * r + 1] = 1;
    std::copy(one.begin(), one.end(), x.begin() + 3 * 20);
    run.expect_error(ErrorKind::data, {"row 20 ", "unit vector"}, [&] { box.forward(x); });
  }
}

// Cases C08 to C11: faces, continuity, resolutions and addresses of the hash grid.

namespace {

/// Every triple of `values`.
std::vector<double> corners(const std::vector<double>& values) {
  std::vector<double> x;
  for (const double a : values) {
    for (const double b : values) {
      for (const double c : values) {
        for (const double v : {a, b, c}) x.push_back(v);
      }
    }
  }
  return x;
}

/// Largest error over rows of x, of a table with entries in +-1.
template <class Real>
double interpolation_error(EncoderBox<Real>& box, std::uint64_t resolution, const std::vector<double>& x) {
  const std::vector<Real> y = box.forward(x);
  const std::int32_t features = box.out_dims();
  long double worst = 0;
  for (std::size_t i = 0; i < y.size(); ++i) {
    const std::size_t row = i / static_cast<std::size_t>(features);
    const auto f = static_cast<std::int32_t>(i % static_cast<std::size_t>(features));
    const long double want = reference_feature<Real>(resolution, box.tensors().value(0), f, x.data() + 3 * row);
    const long double error = std::abs(long_double(y[i]) - want);
    if (!(error <= worst)) worst = error;
  }
  return static_cast<double>(worst);
}

class Collector final : public ParamDeclarer {
 public:
  int tensor(TensorSpec spec) override {
    specs.push_back(std::move(spec));
    return static_cast<int>(specs.size()) - 1;
  }
  std::vector<TensorSpec> specs;
};

}  // namespace

void hash_faces(CaseRun& run) {
  const std::vector<double> x = corners({0.0, 1.0, 0.5, 1 - 0x1p-24, 1 - 0x1p-53, 0x1p-24, 5e-324, -1e-7, 1 + 1e-7});
  const auto rows = static_cast<std::int64_t>(x.size() / 3);
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const std::int64_t resolution : {1, 2, 16, 24, 97, 2048}) {  // 97 and 2,048 hash into 2^14 entries
      for (const int features : {1, 2, 4, 8}) {
        EncoderBox<Real> box(run.registry(), "hash_grid", one_level(resolution, 14, features));
        run.measure(interpolation_error(box, static_cast<std::uint64_t>(resolution), x), tolerance_of<Real>(5e-7),
                    "trilinear");
        // Weights of a row sum to 1; tables lie between guards of NaN, and gradients may not touch theirs.
        const TensorSpec& spec = box.tensors().specs()[0];
        testkit::Guarded<Real> ones(spec.rows, spec.cols), grads(spec.rows, spec.cols);
        ones.fill(Real(1));
        grads.fill(Real(0));
        const View<Real> value = ones.view(), grad = grads.view();
        const Tensors<Real> tensors{{&value, 1}, {&grad, 1}};
        std::vector<Real> y(static_cast<std::size_t>(rows * features)), dy(y.size(), Real(1));
        box.encoder().forward(box.context(), tensors, {x.data(), rows, 3}, {y.data(), rows, features});
        for (const Real sum : y) run.near(sum, 1, tolerance_of<Real>(2e-7), "sum w");
        std::vector<Real> dx(x.size());
        box.encoder().backward(box.context(), tensors, {x.data(), rows, 3}, {dy.data(), rows, features},
                               {dx.data(), rows, 3});
        run.expect(grads.broken_guard().empty(), "gradients stay inside the table");
        long double spread = 0;
        for (std::int64_t r = 0; r < spec.rows; ++r) spread += long_double(grad(r, 0));
        run.relative(spread, rows, tolerance_of<Real>(2e-6), "gradient handed to the table");
      }
    }
  });
}

IN_BOTH_PRECISIONS(hash_continuity) {
  double steepest = 0;
  for (const std::int64_t resolution : {std::int64_t{3}, std::int64_t{16}, std::int64_t{97}, std::int64_t{1000},
                                        std::int64_t{65537}, std::int64_t{1} << 20}) {
    EncoderBox<Real> box(run.registry(), "hash_grid", one_level(resolution, 14));
    Numbers numbers(static_cast<std::uint64_t>(resolution));
    std::vector<double> below, above;
    for (int i = 0; i < 600; ++i) {
      double low[3], high[3];
      for (double& v : low) v = numbers.uniform();
      std::copy(low, low + 3, high);
      const int axis = i % 3;
      const double border =
          std::floor(1 + numbers.uniform() * static_cast<double>(resolution - 1)) / static_cast<double>(resolution);
      const bool wide = i % 2 != 0;  // one ulp of float64, or one of fp32
      low[axis] =
          wide ? static_cast<double>(std::nextafterf(static_cast<float>(border), 0.f)) : std::nextafter(border, 0.0);
      high[axis] =
          wide ? static_cast<double>(std::nextafterf(static_cast<float>(border), 1.f)) : std::nextafter(border, 1.0);
      below.insert(below.end(), low, low + 3);
      above.insert(above.end(), high, high + 3);
    }
    const std::vector<Real> a = box.forward(below), b = box.forward(above);
    for (std::size_t i = 0; i < a.size(); ++i) {
      double step = 0;
      for (std::size_t d = 0; d < 3; ++d) step += above[3 * (i / 2) + d] - below[3 * (i / 2) + d];
      // Entries lie in +-1, so a step across an axis changes at most 2 per cell.
      const double allowed = 2 * static_cast<double>(resolution) * step;
      const double jump = std::abs(static_cast<double>(a[i]) - static_cast<double>(b[i]));
      run.measure(std::max(0.0, jump - allowed), tolerance_of<Real>(2e-6), "jump above the Lipschitz bound");
      steepest = std::max(steepest, jump);
    }
  }
  run.note(fmt::format("largest jump {:.1e}, of one fp32 ulp at N = 2^20", steepest));
}

IN_BOTH_PRECISIONS(hash_resolution) {
  Numbers numbers(11);
  std::vector<double> x, stored;
  for (int i = 0; i < 3 * 700; ++i) {
    x.push_back(numbers.uniform());
    stored.push_back(static_cast<double>(static_cast<float>(x.back())));
  }
  double quantum = 0;
  for (int bits = 10; bits <= 20; ++bits) {
    const std::int64_t resolution = std::int64_t{1} << bits;
    EncoderBox<Real> box(run.registry(), "hash_grid", one_level(resolution, 14));
    // Cells are found in float64: the error does not grow with N, where fp32 coordinates would leave log2 N - 24
    // bits.
    run.measure(interpolation_error(box, static_cast<std::uint64_t>(resolution), x), tolerance_of<Real>(5e-7, 1e-12),
                fmt::format("N = 2^{}", bits));
    const std::vector<Real> fine = box.forward(x), coarse = box.forward(stored);
    double off = 0;
    for (std::size_t i = 0; i < fine.size(); ++i)
      off = std::max(off, std::abs(static_cast<double>(fine[i]) - static_cast<double>(coarse[i])));
    // Half a quantum 2^(log2 N - 24) along each axis, 2 per cell.
    run.expect(off <= 3 * std::ldexp(1.0, bits - 24) + tolerance_of<Real>(1e-6), "fp32 coordinates: half a quantum");
    quantum = off;
  }
  // No power of two: x N is rounded once, to 2^-53 N of a cell, 2 per cell along each axis.
  EncoderBox<Real> odd(run.registry(), "hash_grid", one_level(1048573, 14));
  run.measure(interpolation_error(odd, 1048573, x), tolerance_of<Real>(5e-7, 6 * 1048573 * 0x1p-53), "N = 1,048,573");
  run.note(fmt::format("fp32 coordinates would be off by {:.2f} at N = 2^20", quantum));
  for (const std::int64_t resolution : {(std::int64_t{1} << 20) + 1, std::int64_t{1} << 21, std::int64_t{1} << 22})
    run.expect_error(ErrorKind::config, {"finest_resolution", "1048576"},
                     [&] { EncoderBox<Real>(run.registry(), "hash_grid", one_level(resolution, 14)); });
}

void hash_index(CaseRun& run) {
  run.row("-");
  int wrapped = 0;
  for (std::uint64_t n = 1624; n <= 4096; ++n) {
    run.expect(vertex_count(static_cast<std::int64_t>(n)) == vertices_of(n), "number of vertices");
    for (const std::uint64_t x : {std::uint64_t{0}, n / 2, n}) {
      for (const std::uint64_t y : {std::uint64_t{0}, n / 3, n}) {
        for (const std::uint64_t z : {std::uint64_t{1}, n - 1, n}) {
          const Wide128 w = static_cast<Wide128>(n) + 1;
          run.expect(dense_index<std::uint64_t>(x, y, z, n + 1) == x + w * (y + w * z), "64-bit address");
          wrapped += x + w * (y + w * z) >= Wide128{1} << 32 ? 1 : 0;
        }
      }
    }
  }
  run.note(fmt::format("{} of the addresses need more than 32 bits", wrapped));
  // Counted in 32 bits, these grids have few enough vertices for a table of 2^24 and would be taken for dense.
  int declared = 0;
  for (std::int64_t n = 1625; n <= 4096 && declared < 8; ++n) {
    const auto low = static_cast<std::uint32_t>(vertices_of(static_cast<std::uint64_t>(n)));
    if (low > std::uint32_t{1} << 24) continue;
    Collector collector;
    EncoderBuild build;
    make_part<float>(run.registry(), "hash_grid", one_level(n, 24), build)->declare(collector);
    run.expect(collector.specs.at(0).rows == std::int64_t{1} << 24, "a grid beyond 2^32 vertices is hashed");
    ++declared;
  }
  run.expect(declared == 8, "grids that wrap were found");
  in_both_precisions(run, [&]<class Real>(Real) {
    Numbers numbers(12);
    std::vector<double> x;
    for (int i = 0; i < 3 * 500; ++i) x.push_back(numbers.uniform());
    for (const std::int64_t resolution : {1625, 2047, 2048, 3000, 4095, 4096}) {
      EncoderBox<Real> box(run.registry(), "hash_grid", one_level(resolution, 12));
      run.measure(interpolation_error(box, static_cast<std::uint64_t>(resolution), x), tolerance_of<Real>(5e-7),
                  "hashed entries");
    }
  });
}

// Cases C12 to C14: gradients of the hash grid.

namespace {

/// Half precision, round to nearest: what is left of a positive value below 2^-14.
double in_half(double value) { return std::ldexp(std::nearbyint(std::ldexp(value, 24)), -24); }

}  // namespace

void hash_small_gradients(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    Numbers numbers(21);
    for (int exponent = -36; exponent <= -4; exponent += exponent < -12 ? 8 : 1) {
      // 512 samples at one vertex of a dense grid and as many within its cell, all of one sign.
      EncoderBox<Real> box(run.registry(), "hash_grid", one_level(16, 14, 2));
      std::vector<double> x;
      std::vector<Real> dy;
      for (int i = 0; i < 1024; ++i) {
        for (int d = 0; d < 3; ++d) x.push_back(i < 512 ? 0.5 : 0.5 + numbers.uniform() / 16);
        for (int f = 0; f < 2; ++f) dy.push_back(static_cast<Real>(std::pow(10.0, exponent) * numbers.in(0.5, 1)));
      }
      box.backward(x, dy);
      long double want = 0, got = 0;
      std::int64_t lost = 0;
      for (const Real g : dy) want += long_double(g);
      for (std::int64_t r = 0; r < box.tensors().grad(0).rows; ++r) {
        for (int f = 0; f < 2; ++f) got += long_double(box.tensors().grad(0)(r, f));
      }
      const std::uint64_t vertex[3] = {8, 8, 8};
      const std::int64_t entry = reference_entry(16, box.tensors().grad(0).rows, vertex);
      for (int f = 0; f < 2; ++f) lost += box.tensors().grad(0)(entry, f) == Real(0) ? 1 : 0;
      run.expect(lost == 0, "no gradient is flushed");
      // 1,024 additions of one sign to an entry round by 6e-5 of it at worst; a tenth is allowed. Beside it, a product
      // of a gradient and a corner's weight counts as 0 below the least normal number: 1e-38, which 1e-36 comes near.
      const double flushed =
          8.0 * static_cast<double>(dy.size()) * static_cast<double>(std::numeric_limits<Real>::min());
      run.relative(got, want, tolerance_of<Real>(6e-6) + flushed / static_cast<double>(want),
                   fmt::format("gradients near 1e{}", exponent));
    }
  });
  run.row("fp16");
  int flushed = 0;
  for (int exponent = -12; exponent <= -4; ++exponent) flushed += in_half(std::pow(10.0, exponent)) == 0 ? 1 : 0;
  run.absent(fmt::format(
      "no fp16 gradients: tables and moments are fp32 ({} of the 9 decades would be flushed at scale 1)", flushed));
}

void hash_one_entry(CaseRun& run) {
  constexpr int kRows = 1 << 18;
  const std::vector<double> x(3 * static_cast<std::size_t>(kRows), 0.0);  // the vertex itself: weight 1
  in_both_precisions(run, [&]<class Real>(Real) {
    Numbers numbers(22);
    std::vector<Real> dy;
    std::vector<long double> want(2, 0), mass(2, 0);
    for (int i = 0; i < 2 * kRows; ++i) {
      dy.push_back(static_cast<Real>(numbers.in(-1, 1)));
      want[i % 2] += long_double(dy.back());
      mass[i % 2] += std::abs(long_double(dy.back()));
    }
    EncoderBox<Real> box(run.registry(), "hash_grid", one_level(1024, 10));  // hashed: entry 0
    Real first[2] = {};
    int differ = 0;
    Workspace workspace;
    StepContext ctx{.workspace = &workspace};
    for (int repeat = 0; repeat < 100; ++repeat) {
      const ThreadScope threads(1 + repeat % 2);
      box.tensors().fill_grads(Real(0));
      box.encoder().backward(ctx, box.tensors().tensors(), {x.data(), kRows, 3}, {dy.data(), kRows, 2}, {});
      const View<Real> grad = box.tensors().grad(0);
      for (int f = 0; f < 2; ++f) {
        if (repeat == 0) first[f] = grad(0, f);
        differ += grad(0, f) == first[f] ? 0 : 1;
      }
    }
    run.measure(differ, 0, "repeats with other bits");
    // Added one after another, in fp32: roundings walk at random, by about sqrt(n) of them; of the sum of magnitudes
    // that is below 2e-7. The same bits for any thread count is what atomics cannot give.
    for (std::size_t f = 0; f < 2; ++f)
      run.measure(static_cast<double>(std::abs(long_double(first[f]) - want[f]) / mass[f]), tolerance_of<Real>(2e-7),
                  "sum");
    run.note("100 repeats on 1 and 2 threads: the same bits");
  });
}

IN_BOTH_PRECISIONS(hash_gradient) {
  for (const char* interpolation : {"linear", "smoothstep"}) {
    for (const std::int64_t resolution : {7, 61}) {  // dense, hashed
      EncoderBox<double> oracle(run.registry(), "hash_grid", one_level(resolution, 10, 4, interpolation));
      EncoderBox<Real> box(run.registry(), "hash_grid", one_level(resolution, 10, 4, interpolation));
      Numbers numbers(23);
      std::vector<double> x;
      std::vector<Real> dy;
      constexpr int kRows = 40;
      for (int i = 0; i < kRows; ++i) {
        for (int d = 0; d < 3; ++d) {  // inside a cell, so that differences of the input stay in it
          const double cell = std::floor(numbers.in(0, static_cast<double>(resolution)));
          x.push_back((cell + numbers.in(0.05, 0.95)) / static_cast<double>(resolution));
        }
        for (int f = 0; f < 4; ++f) dy.push_back(static_cast<Real>(numbers.in(-1, 1)));
      }
      const auto loss = [&] {
        const std::vector<double> y = oracle.forward(x);
        long double sum = 0;
        for (std::size_t i = 0; i < y.size(); ++i) sum += long_double(y[i]) * long_double(dy[i]);
        return sum;
      };
      const std::vector<Real> dx = box.backward(x, dy);
      const double h = 1e-3 / static_cast<double>(resolution);
      double largest = 0;
      for (const Real g : dx) largest = std::max<double>(largest, std::abs(g));
      for (std::size_t i = 0; i < x.size(); ++i) {
        const double keep = x[i];
        // Along an axis features are linear, or cubic: a fourth-order difference is exact for both.
        long double at[4];
        const double steps[4] = {-2 * h, -h, h, 2 * h};
        double moved[4];
        for (int s = 0; s < 4; ++s) {
          x[i] = keep + steps[s];
          moved[s] = x[i];
          at[s] = loss();
        }
        x[i] = keep;
        const long double near = (at[2] - at[1]) / long_double(moved[2] - moved[1]);
        const long double wide = (at[3] - at[0]) / long_double(moved[3] - moved[0]);
        run.measure(static_cast<double>(std::abs(long_double(dx[i]) - (4 * near - wide) / 3)) / largest,
                    std::is_same_v<Real, float> ? 2e-6 : 1e-7, "by coordinates");
      }
      const View<Real> grad = box.tensors().grad(0);
      const View<double> value = oracle.tensors().value(0);
      double scale = 0;
      for (std::int64_t i = 0; i < grad.size(); ++i) scale = std::max<double>(scale, std::abs(grad.data[i]));
      for (std::int64_t i = 0; i < grad.size(); ++i) {
        if (i % 7 != 0 && grad.data[i] == Real(0)) continue;  // every entry with a gradient, and a seventh of the rest
        const double keep = value.data[i];
        value.data[i] = keep + 1;  // linear in the table: any step will do
        const long double up = loss();
        value.data[i] = keep - 1;
        const long double down = loss();
        value.data[i] = keep;
        run.measure(static_cast<double>(std::abs(long_double(grad.data[i]) - (up - down) / 2)) / scale,
                    std::is_same_v<Real, float> ? 2e-6 : 1e-7, "by entries");
      }
    }
  }
}

}  // namespace semfield::numerics
