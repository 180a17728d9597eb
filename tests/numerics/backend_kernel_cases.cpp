// I01 to I04: the kernels of every instruction set side by side.
#include <algorithm>
#include <atomic>
#include <cstdio>
#include <cstring>

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

#include "backend_parts.h"
#include "compute/math_functions.h"
#include "compute/parallel.h"
#include "core/rng.h"
#include "testkit/laws.h"
#include "thread_scope.h"

namespace semfield::numerics {

namespace {

double number(std::uint64_t index) {
  return static_cast<double>(uniform01({11, 0, stream_id("stiff backend")}, index));
}

std::string name_of(Isa isa) { return std::string(isa_name(isa)); }

// The four elementary loops with their truths.
template <class Real>
struct Function {
  const char* name;
  void (*CpuKernels<Real>::*loop)(Real*, std::int64_t);
  long double (*truth)(long double);
  double low, high;
};
template <class Real>
std::vector<Function<Real>> functions() {
  const bool wide = sizeof(Real) == 8;
  return {{"exp", &CpuKernels<Real>::exp_inplace, [](long double x) { return std::exp(x); }, wide ? -708.0 : -87.0,
           wide ? 709.0 : 88.7},
          {"expm1", &CpuKernels<Real>::expm1_inplace, [](long double x) { return std::expm1(x); }, -50, 80},
          {"sigmoid", &CpuKernels<Real>::sigmoid_inplace,
           [](long double x) { return x < 0 ? std::exp(x) / (1 + std::exp(x)) : 1 / (1 + std::exp(-x)); }, -87, 60},
          {"softplus", &CpuKernels<Real>::softplus_inplace,
           [](long double x) { return std::max(x, 0.0L) + std::log1p(std::exp(-std::abs(x))); }, -87, 100}};
}

// Arguments over the whole range, and more of them around 0, small and large.
template <class Real>
std::vector<Real> arguments(double low, double high, std::size_t count) {
  std::vector<Real> x(count);
  for (std::size_t i = 0; i < count; ++i) {
    const double u = number(2 * i), v = number(2 * i + 1);
    if (i % 3 == 0) x[i] = static_cast<Real>(low + (high - low) * u);
    if (i % 3 == 1) x[i] = static_cast<Real>(2 * u - 1);
    if (i % 3 == 2) x[i] = static_cast<Real>((u < 0.5 ? -1 : 1) * std::pow(10.0, -12 * v));
    x[i] = std::clamp(x[i], static_cast<Real>(low), static_cast<Real>(high));
  }
  return x;
}

// Distance in units of the last place of the true value.
template <class Real>
double ulps(Real value, long double truth) {
  int exponent = 0;
  std::frexp(truth, &exponent);
  const int last = std::max(exponent, std::numeric_limits<Real>::min_exponent) - std::numeric_limits<Real>::digits;
  return static_cast<double>(std::abs(static_cast<long double>(value) - truth) / std::ldexp(1.0L, last));
}

std::string two_digits(double value) {
  char text[24];
  std::snprintf(text, sizeof text, "%.2f", value);
  return text;
}

}  // namespace

const std::map<std::string, std::string>& sine_settings() {
  static const std::map<std::string, std::string> settings{
      {"frequencies", "10"}, {"include_input", "false"}, {"angular", "pi"}};
  return settings;
}

template <class Real>
double worst_sine(const Encoder<Real>& encoder) {
  constexpr int kBands = 10, kRows = 500;
  std::vector<double> x(3 * kRows);
  for (std::size_t i = 0; i < x.size(); ++i) x[i] = 2 * number(i) - 1;
  const std::int32_t width = 6 * kBands;
  std::vector<Real> y(static_cast<std::size_t>(kRows * width));
  encoder.forward({}, {}, View<const double>(x.data(), kRows, 3), View<Real>(y.data(), kRows, width));
  double worst = 0;
  for (int row = 0; row < kRows; ++row) {
    // The columns of a row as a set: which stands where is the encoder's matter (group C looks at that).
    std::vector<long double> truth;
    for (int k = 0; k < kBands; ++k) {
      for (int a = 0; a < 3; ++a) {
        const long double turn = std::remainder(std::ldexp(static_cast<long double>(x[3 * row + a]), k), 2.0L);
        truth.push_back(std::sin(3.14159265358979323846264338327950288L * turn));
        truth.push_back(std::cos(3.14159265358979323846264338327950288L * turn));
      }
    }
    std::vector<Real> got(y.begin() + row * width, y.begin() + (row + 1) * width);
    std::sort(truth.begin(), truth.end());
    std::sort(got.begin(), got.end());
    for (std::size_t i = 0; i < got.size(); ++i)
      worst = std::max(worst, static_cast<double>(std::abs(static_cast<long double>(got[i]) - truth[i])) /
                                  std::numeric_limits<Real>::epsilon());
  }
  return worst;
}
template double worst_sine(const Encoder<float>&);
template double worst_sine(const Encoder<double>&);

void min_max_nan(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const Real nan = std::numeric_limits<Real>::quiet_NaN(), inf = std::numeric_limits<Real>::infinity();
    for (const IsaTable<Real>& table : isa_tables<Real>()) {
      const CpuKernels<Real>& k = table.kernels;
      const std::string on = " on " + name_of(table.isa);
      for (std::int64_t n = 1; n <= 70; ++n) {
        std::vector<Real> x(static_cast<std::size_t>(n));
        for (std::size_t i = 0; i < x.size(); ++i) x[i] = static_cast<Real>(number(i) - 2);
        run.expect(k.all_finite(x.data(), n), "sound numbers are finite" + on);
        const Real most = *std::max_element(x.begin(), x.end());
        run.expect(k.largest_of(x.data(), n) == most, "the largest is found" + on);
        for (std::size_t at = 0; at < x.size(); ++at) {
          const Real keep = x[at];
          for (const Real bad : {nan, -nan, inf, -inf}) {
            x[at] = bad;
            run.expect(!k.all_finite(x.data(), n), "a bad number is seen at every place" + on);
          }
          x[at] = nan;
          if (n > 1) {
            Real others = -inf;
            for (std::size_t i = 0; i < x.size(); ++i) others = i == at ? others : std::max(others, x[i]);
            run.expect(k.largest_of(x.data(), n) == others, "the largest passes over NaN" + on);
          }
          run.expect(std::isnan(k.sum_of(x.data(), n)), "a sum does not" + on);
          x[at] = keep;
        }
        std::fill(x.begin(), x.end(), nan);
        run.expect(std::isnan(k.largest_of(x.data(), n)), "NaN when nothing else is there" + on);
      }
      for (const Function<Real>& f : functions<Real>()) {
        std::vector<Real> x(37, Real(0.5));
        x[17] = nan;
        (k.*f.loop)(x.data(), 37);
        for (std::size_t i = 0; i < x.size(); ++i)
          run.expect(std::isnan(x[i]) == (i == 17), std::string(f.name) + " keeps NaN, and to itself" + on);
      }
      // ReLU after a product: NaN stays NaN, in its row alone; its gradient is 0 where the result was NaN.
      const std::int32_t rows = 9, cols = 21, depth = 13;
      std::vector<Real> a(rows * depth, Real(1)), b(depth * cols, Real(-1)), c(rows * cols);
      a[4 * depth + 3] = nan;
      Gemm<Real> g;
      g.m = rows, g.n = cols, g.k = depth;
      g.a = a.data(), g.a_row = depth;
      g.b = b.data(), g.b_row = cols;
      g.c = c.data(), g.c_row = cols;
      g.relu = true;
      k.gemm(g);
      for (std::int32_t i = 0; i < rows * cols; ++i) {
        const Real value = c[i];
        run.expect(i / cols == 4 ? std::isnan(value) : value == 0, "a ReLU keeps NaN in its row" + on);
      }
      std::vector<Real> dy(c.size(), Real(1));
      k.relu_backward(View<const Real>(c.data(), rows, cols), View<Real>(dy.data(), rows, cols));
      run.expect(std::all_of(dy.begin(), dy.end(), [](Real d) { return d == 0; }), "no gradient passes it" + on);
    }
  });
}

void fused_or_not(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const auto tables = isa_tables<Real>();
    if (tables.size() < 2) return run.absent("one set of kernels runs here: there is nothing to compare");
    const double u = std::numeric_limits<Real>::epsilon() / 2;
    std::string figures;
    for (const Function<Real>& f : functions<Real>()) {
      const std::vector<Real> x = arguments<Real>(f.low, f.high, 12'000);
      std::vector<Real> plain = x;
      (tables[0].kernels.*f.loop)(plain.data(), static_cast<std::int64_t>(x.size()));
      double worst = 0;
      for (std::size_t t = 1; t < tables.size(); ++t) {
        std::vector<Real> fused = x;
        (tables[t].kernels.*f.loop)(fused.data(), static_cast<std::int64_t>(x.size()));
        for (std::size_t i = 0; i < x.size(); ++i) worst = std::max(worst, relative_error(fused[i], plain[i]) / u);
      }
      run.measure(worst, 4, std::string(f.name) + ", in u");
      figures += std::string(figures.empty() ? "" : ", ") + f.name + " " + two_digits(worst) + " u";
    }
    // Products of 256 terms: the difference against the sum of the terms' sizes.
    const std::int64_t m = 24, n = 40, k = 256;
    std::vector<Real> a(static_cast<std::size_t>(m * k)), b(static_cast<std::size_t>(k * n));
    for (std::size_t i = 0; i < a.size(); ++i) a[i] = static_cast<Real>(2 * number(i) - 1);
    for (std::size_t i = 0; i < b.size(); ++i) b[i] = static_cast<Real>(2 * number(100'000 + i) - 1);
    std::vector<std::vector<Real>> c;
    for (const IsaTable<Real>& table : tables) {
      c.emplace_back(static_cast<std::size_t>(m * n));
      Gemm<Real> g;
      g.m = m, g.n = n, g.k = k;
      g.a = a.data(), g.a_row = k;
      g.b = b.data(), g.b_row = n;
      g.c = c.back().data(), g.c_row = n;
      table.kernels.gemm(g);
    }
    double worst = 0, sums = 0;
    for (std::int64_t i = 0; i < m * n; ++i) {
      long double scale = 0;
      for (std::int64_t j = 0; j < k; ++j)
        scale += std::abs(static_cast<long double>(a[i / n * k + j]) * b[j * n + i % n]);
      for (std::size_t t = 1; t < c.size(); ++t) {
        const auto e = static_cast<std::size_t>(i);
        worst = std::max(worst, static_cast<double>(std::abs(static_cast<long double>(c[t][e]) - c[0][e]) / scale) / u);
      }
    }
    run.measure(worst, 4, "product of 256 terms, in u of the sum of sizes");
    for (const IsaTable<Real>& table : tables)
      sums =
          std::max(sums, std::abs(table.kernels.sum_of(a.data(), m * k) - tables[0].kernels.sum_of(a.data(), m * k)));
    run.measure(sums, 0, "sum_of");
    run.note(figures + ", product " + two_digits(worst) + " u");
  });
}

void flush_to_zero(CaseRun& run) {
#if !defined(__x86_64__)
  run.absent("flushing to zero is a mode of x86 processors");
#else
  run.row("fp32");
  // Every task flushes, on whatever thread it runs, and no library that was loaded has switched it on anywhere else.
  constexpr unsigned kFlush = 0x8000, kInputsAsZero = 0x0040, kBoth = kFlush | kInputsAsZero;
  std::atomic<int> keeping{0};
  for (const int threads : {1, 2, 16}) {
    const ThreadScope scope(threads);
    parallel_for(64, [&](std::int64_t) { keeping += (_mm_getcsr() & kBoth) == kBoth ? 0 : 1; });
    run.measure(_mm_getcsr() & kBoth, 0, "the caller's own mode is untouched");
  }
  run.measure(keeping, 0, "tasks that keep subnormal numbers");
  const unsigned before = _mm_getcsr();
  struct Restore {
    unsigned mode;
    ~Restore() { _mm_setcsr(mode); }
  } restore{before};
  double kept = 0, flushed = 0;
  for (const IsaTable<float>& table : isa_tables<float>()) {
    std::vector<float> x;
    for (int i = 0; i < 900; ++i) x.push_back(-87.0F - 0.02F * static_cast<float>(i));  // e^x from 1e-38 to 0
    std::vector<float> y = x, z = x;
    table.kernels.exp_inplace(y.data(), static_cast<std::int64_t>(y.size()));
    _mm_setcsr(before | kBoth);
    table.kernels.exp_inplace(z.data(), static_cast<std::int64_t>(z.size()));
    _mm_setcsr(before);
    for (std::size_t i = 0; i < x.size(); ++i) {
      kept = std::max(kept, ulps(y[i], std::exp(static_cast<long double>(x[i]))));
      flushed = std::max(flushed, std::abs(static_cast<double>(y[i]) - static_cast<double>(z[i])));
      run.expect(z[i] >= 0, "flushed results are no NaN");
    }
    run.expect(y.back() == 0 && y[200] > 0 && y[200] < std::numeric_limits<float>::min(), "subnormal results are kept");
    // A product whose terms are subnormal: 16 x 1e-40 is kept, or is 0 where it is flushed.
    std::vector<float> a(16, 1e-20F), b(16 * 8, 1e-20F), c(8), d(8);
    Gemm<float> g;
    g.m = 1, g.n = 8, g.k = 16;
    g.a = a.data(), g.a_row = 16;
    g.b = b.data(), g.b_row = 8;
    g.c = c.data(), g.c_row = 8;
    table.kernels.gemm(g);
    g.c = d.data();
    _mm_setcsr(before | kBoth);
    table.kernels.gemm(g);
    _mm_setcsr(before);
    for (std::size_t i = 0; i < 8; ++i) {
      run.measure(std::abs(static_cast<double>(c[i]) - 1.6e-39), 16 * 0x1p-149, "product of small numbers");
      flushed = std::max(flushed, std::abs(static_cast<double>(c[i]) - static_cast<double>(d[i])));
    }
  }
  run.measure(kept, 2, "subnormal results, units in the last place");
  run.measure(flushed, 1.2e-38, "what flushing changes");
#endif
}

void ulp_table(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    std::string figures;
    for (const Function<Real>& f : functions<Real>()) {
      const std::vector<Real> x = arguments<Real>(f.low, f.high, 15'000);
      figures += std::string(figures.empty() ? "" : "; ") + f.name;
      for (const IsaTable<Real>& table : isa_tables<Real>()) {
        std::vector<Real> y = x;
        (table.kernels.*f.loop)(y.data(), static_cast<std::int64_t>(y.size()));
        double worst = 0;
        for (std::size_t i = 0; i < x.size(); ++i) worst = std::max(worst, ulps(y[i], f.truth(x[i])));
        // exp keeps 2. The others end in a division or a sum of two parts that are rounded already, and promise 4e-7 of
        // their value, which is between 3.4 and 6.7 units.
        run.measure(worst, std::string_view(f.name) == "exp" ? 2 : 4,
                    std::string(f.name) + " on " + name_of(table.isa));
        figures += " " + two_digits(worst);
        // The ends of the range, and what does not depend on the place in the array.
        const Real ends[] = {
            Real(1e30), Real(-1e30), std::numeric_limits<Real>::infinity(), -std::numeric_limits<Real>::infinity(),
            Real(0),    Real(-0.0)};
        for (const Real end : ends) {
          std::vector<Real> z(33, end);
          (table.kernels.*f.loop)(z.data(), 33);
          const auto truth = static_cast<Real>(f.truth(end));
          for (const Real value : z) run.expect(value == truth, std::string(f.name) + " at the ends");
        }
      }
    }
    // sin and cos are those of the frequency encoder: sin(2^k pi x), cos(2^k pi x), from float64 positions.
    const PluginEntry* entry = run.registry().find(PluginKind::encoder, "frequency");
    if (entry != nullptr) {
      const auto params = testkit::make_params(*entry, sine_settings());
      const auto encoder = [&] {
        if constexpr (std::is_same_v<Real, float>) {
          return entry->encoder32(*params, {}, run.registry().kernels());
        } else {
          return entry->encoder64(*params, {}, run.registry().kernels());
        }
      }();
      const double worst = worst_sine<Real>(*encoder);
      run.measure(worst, 2, "sin and cos, in units of the last place of 1");
      figures += "; sin and cos of the encoder " + two_digits(worst);
    }
    std::string sets;
    for (const IsaTable<Real>& table : isa_tables<Real>()) sets += (sets.empty() ? "" : ", ") + name_of(table.isa);
    run.note("units in the last place on " + sets + ": " + figures + "; log is that of the C library");
  });
}

}  // namespace semfield::numerics
