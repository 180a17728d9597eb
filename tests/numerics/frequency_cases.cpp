// Cases C01 to C07: positional encoding and directions.
#include <fmt/format.h>

#include "encoder_box.h"
#include "model_bench.h"
#include "training_box.h"

#if defined(SEMFIELD_HAS_QUADMATH)
#include <quadmath.h>
#endif

namespace semfield::numerics {

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

}  // namespace

void pe_ten_bands(CaseRun& run) {
  std::vector<double> x = uniform(2000, 1, 1);
  for (const double edge : {0.0, 1.0, -1.0, 0.5, 0x1p-30, 0x1p-140}) x.push_back(edge);
  const std::vector<Wide> want[] = {reference_bands(widened(x), 10, "radian"), reference_bands(widened(x), 10, "pi")};
  in_both_precisions(run, [&]<class Real>(Real) {
    for (int a = 0; a < 2; ++a) {
      EncoderBox<Real> box(run.registry(), "frequency", settings(10, kAngulars[a]), 1);
      run.measure(largest(errors_by_band(box.forward(x), want[a], 10)), tolerance_of<Real>(1.2e-7), kAngulars[a]);
    }
  });
}

void pe_stored_x(CaseRun& run) {
  std::vector<double> x = uniform(300, 1, 2);
  for (const double v : uniform(300, 10, 3)) x.push_back(v);
  for (const double v : spread(600, -20, 20, 4)) x.push_back(v);
  const std::vector<Wide> want[] = {reference_bands(widened(x), 40, "radian"), reference_bands(widened(x), 40, "pi")};
  in_both_precisions(run, [&]<class Real>(Real) {
    for (int a = 0; a < 2; ++a) {
      EncoderBox<Real> box(run.registry(), "frequency", settings(40, kAngulars[a]), 1);
      run.measure(largest(errors_by_band(box.forward(x), want[a], 40)), tolerance_of<Real>(1.2e-7), kAngulars[a]);
    }
    // What the exact reduction is for: the angle rounded to fp32, as a plain program has it, on the first 300 x.
    EncoderBox<Real> naive(run.registry(), "frequency", settings(40, "pi", "naive"), 1);
    const std::vector<double> unit(x.begin(), x.begin() + 300);
    const std::vector<double> off = errors_by_band(naive.forward(unit), want[1], 40);
    run.expect(off[22] > 0.1, "an angle rounded to fp32 loses band 22");
    run.note(fmt::format("'naive' at |x| <= 1: {:.1e} in band 9, {:.2f} in band 22", off[9], off[22]));
  });
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
    run.measure(std::abs(bands - (std::string(arithmetic) == "naive" ? 18 : 19)), 0, "bands that count");
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

void directions(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    EncoderBox<Real> box(run.registry(), "spherical_harmonics", {{"degree", "5"}});
    // On the axis z only m = 0 remains: Y_l0 = sqrt((2l + 1) / 4 pi) (+-1)^l.
    const long double pi = 3.14159265358979323846264338327950288L;
    for (const int sign : {1, -1}) {
      const std::vector<Real> y = box.forward({0, 0, static_cast<double>(sign)});
      for (int l = 0; l < 5; ++l) {
        for (int m = -l; m <= l; ++m) {
          const Real value = y[l * l + l + m];
          const long double want = m == 0 ? std::sqrt((2 * l + 1) / (4 * pi)) * (l % 2 == 0 ? 1 : sign) : 0.0L;
          run.measure(relative_error(value, want), m == 0 ? tolerance_of<Real>(2.4e-7) : 0.0, "on the axis");
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
          squares += static_cast<long double>(y[25 * r + i]) * static_cast<long double>(y[25 * r + i]);
        run.measure(relative_error(squares, static_cast<long double>(2 * l + 1) / (4 * pi)), tolerance_of<Real>(4e-6),
                    "addition theorem");
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
  });
}

}  // namespace semfield::numerics
