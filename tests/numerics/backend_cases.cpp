// What the files of group I share: the kernels of every instruction set side by side, and a device under test.

#include <dlfcn.h>
#include <fmt/format.h>
#include <sys/mman.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <sstream>

#include "compute/isa.h"
#include "compute/layers.h"
#include "compute/math_functions.h"
#include "compute/parallel.h"
#include "core/checksum.h"
#include "core/text.h"
#include "datasets/obj_room/obj_room.h"
#include "eval/metrics.h"
#include "execution/device_library.h"
#include "isa_list.h"
#include "model/optim/adam.h"
#include "named_case.h"
#include "rooms.h"
#include "scene/classes/class_table.h"
#include "surface/mesh/marching_cubes.h"
#include "testkit/benches.h"
#include "testkit/host_twin.h"
#include "tests/encoder_box.h"
#include "tests/model/rays_of_slabs.h"
#include "tests/scene/room_files.h"
#include "train/ray_source.h"

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

namespace semfield {

// The makers that compute/isa.cpp chooses from; the suite calls each of them.
#define SEMFIELD_DECLARE(name)                  \
  namespace isa_##name {                        \
    void fill_cpu_kernels(CpuKernels<float>&);  \
    void fill_cpu_kernels(CpuKernels<double>&); \
  }
SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE)
#undef SEMFIELD_DECLARE
}  // namespace semfield

namespace semfield::numerics {

/// The same cases' rows on a device beside the CPU, "fp32 on cuda".
struct DeviceUnderTest {
  Registry registry;  ///< with the device's kernels
  DeviceCalls calls;
};
/// Opens a row; without a device it is absent, with the reason, and nothing is returned.
std::optional<DeviceUnderTest> device_row(CaseRun& run, std::string_view precision = "fp32 on cuda");
void encoder_guards_on_device(CaseRun& run, const DeviceUnderTest& device);

/// Frequencies and angle of the encoder whose sines are looked at, and their largest error in units of the last place
/// of 1.
const std::map<std::string, std::string>& sine_settings();
template <class Real>
double worst_sine(const Encoder<Real>& encoder);

template <class Real>
struct IsaTable {
  Isa isa = Isa::generic;
  CpuKernels<Real> kernels{};
};

/// Kernels of every instruction set of this build up to the one in use, weakest first.
template <class Real>
std::vector<IsaTable<Real>> isa_tables() {
  std::vector<IsaTable<Real>> out;
  const auto add = [&](Isa which, void (*make)(CpuKernels<Real>&)) {
    if (which > isa()) return;
    IsaTable<Real> table{which, {}};
    make(table.kernels);
    out.push_back(table);
  };
#define SEMFIELD_LIST(name) add(Isa::name, isa_##name::fill_cpu_kernels);
  SEMFIELD_FOR_EACH_ISA(SEMFIELD_LIST)
#undef SEMFIELD_LIST
  return out;
}

// I01 to I04: the kernels of every instruction set side by side.

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

// c [m, n] = a [m, k] b [k, n], rows without gaps.
template <class Real>
Gemm<Real> product(std::int64_t m, std::int64_t n, std::int64_t k, const Real* a, const Real* b, Real* c) {
  return {.m = m, .n = n, .k = k, .a = a, .a_row = k, .b = b, .b_row = n, .c = c, .c_row = n};
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
  return static_cast<double>(std::abs(long_double(value) - truth) / std::ldexp(1.0L, last));
}

std::string two_digits(double value) { return fmt::format("{:.2f}", value); }

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
        const long double turn = std::remainder(std::ldexp(long_double(x[3 * row + a]), k), 2.0L);
        truth.push_back(std::sin(3.14159265358979323846264338327950288L * turn));
        truth.push_back(std::cos(3.14159265358979323846264338327950288L * turn));
      }
    }
    std::vector<Real> got(y.begin() + row * width, y.begin() + (row + 1) * width);
    std::sort(truth.begin(), truth.end());
    std::sort(got.begin(), got.end());
    for (std::size_t i = 0; i < got.size(); ++i)
      worst = std::max(
          worst, static_cast<double>(std::abs(long_double(got[i]) - truth[i])) / std::numeric_limits<Real>::epsilon());
  }
  return worst;
}
template double worst_sine(const Encoder<float>&);
template double worst_sine(const Encoder<double>&);

IN_BOTH_PRECISIONS(min_max_nan) {
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
    Gemm<Real> g = product(rows, cols, depth, a.data(), b.data(), c.data());
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
}

IN_BOTH_PRECISIONS(fused_or_not) {
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
    table.kernels.gemm(product(m, n, k, a.data(), b.data(), c.back().data()));
  }
  double worst = 0, sums = 0;
  for (std::int64_t i = 0; i < m * n; ++i) {
    long double scale = 0;
    for (std::int64_t j = 0; j < k; ++j) scale += std::abs(long_double(a[i / n * k + j]) * b[j * n + i % n]);
    for (std::size_t t = 1; t < c.size(); ++t) {
      const auto e = static_cast<std::size_t>(i);
      worst = std::max(worst, static_cast<double>(std::abs(long_double(c[t][e]) - c[0][e]) / scale) / u);
    }
  }
  run.measure(worst, 4, "product of 256 terms, in u of the sum of sizes");
  for (const IsaTable<Real>& table : tables)
    sums = std::max(sums, std::abs(table.kernels.sum_of(a.data(), m * k) - tables[0].kernels.sum_of(a.data(), m * k)));
  run.measure(sums, 0, "sum_of");
  run.note(figures + ", product " + two_digits(worst) + " u");
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
      kept = std::max(kept, ulps(y[i], std::exp(long_double(x[i]))));
      flushed = std::max(flushed, std::abs(static_cast<double>(y[i]) - static_cast<double>(z[i])));
      run.expect(z[i] >= 0, "flushed results are no NaN");
    }
    run.expect(y.back() == 0 && y[200] > 0 && y[200] < std::numeric_limits<float>::min(), "subnormal results are kept");
    // A product whose terms are subnormal: 16 x 1e-40 is kept, or is 0 where it is flushed.
    std::vector<float> a(16, 1e-20F), b(16 * 8, 1e-20F), c(8), d(8);
    Gemm<float> g = product(1, 8, 16, a.data(), b.data(), c.data());
    table.kernels.gemm(g);
    g.c = d.data();
    _mm_setcsr(before | kBoth);
    table.kernels.gemm(g);
    _mm_setcsr(before);
    for (std::size_t i = 0; i < 8; ++i) {
      run.near(c[i], 1.6e-39, 16 * 0x1p-149, "product of small numbers");
      flushed = std::max(flushed, std::abs(static_cast<double>(c[i]) - static_cast<double>(d[i])));
    }
  }
  run.measure(kept, 2, "subnormal results, units in the last place");
  run.measure(flushed, 1.2e-38, "what flushing changes");
#endif
}

IN_BOTH_PRECISIONS(ulp_table) {
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
      run.measure(worst, std::string_view(f.name) == "exp" ? 2 : 4, std::string(f.name) + " on " + name_of(table.isa));
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
  if (run.registry().find(PluginKind::encoder, "frequency") != nullptr) {
    const auto encoder = testkit::make_part<Real>(run.registry(), "frequency", sine_settings(), EncoderBuild{});
    const double worst = worst_sine<Real>(*encoder);
    run.measure(worst, 2, "sin and cos, in units of the last place of 1");
    figures += "; sin and cos of the encoder " + two_digits(worst);
  }
  std::string sets;
  for (const IsaTable<Real>& table : isa_tables<Real>()) sets += (sets.empty() ? "" : ", ") + name_of(table.isa);
  run.note("units in the last place on " + sets + ": " + figures + "; log is that of the C library");
}

// I05: arithmetic of indices beyond 2^31 elements. Addresses are reserved, memory is not: rows stand hundreds of
// millions of elements apart, and only the pages that they touch are ever filled.

namespace {

constexpr std::int64_t kTwo31 = std::int64_t{1} << 31;

// Addresses of `bytes` bytes; a page gets memory when it is written.
class Reserved : NonCopyable {
 public:
  explicit Reserved(std::size_t bytes)
      : bytes_(bytes),
        memory_(::mmap(nullptr, bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0)) {}
  ~Reserved() {
    if (there()) ::munmap(memory_, bytes_);
  }
  /// For so many numbers.
  template <class T>
  static Reserved of(std::int64_t count) {
    return Reserved(sizeof(T) * static_cast<std::size_t>(count));
  }
  bool there() const { return memory_ != MAP_FAILED; }
  template <class T>
  T* as() const {
    return static_cast<T*>(memory_);
  }

 private:
  std::size_t bytes_;
  void* memory_;
};

double backend_index_number(std::uint64_t index) {
  return 2 * static_cast<double>(uniform01({13, 0, stream_id("stiff index")}, index)) - 1;
}

// A packed matrix of `from`'s numbers in rows `stride` elements apart.
template <class Real>
View<Real> spread(const std::vector<Real>& from, std::int64_t rows, std::int32_t cols, std::int64_t stride,
                  Real* base) {
  View<Real> view(base, rows, cols, stride);
  for (std::int64_t r = 0; r < rows; ++r)
    std::memcpy(view.row(r), from.data() + r * cols, sizeof(Real) * static_cast<std::size_t>(cols));
  return view;
}

template <class Real>
double differing(View<const Real> far, const std::vector<Real>& packed) {
  int count = 0;
  for (std::int64_t r = 0; r < far.rows; ++r) {
    for (std::int32_t c = 0; c < far.cols; ++c) count += far(r, c) == packed[r * far.cols + c] ? 0 : 1;
  }
  return count;
}

template <class Real>
void strided_products(CaseRun& run) {
  const std::int64_t rows = 5, stride = 600'000'000;  // the last row begins at element 2.4e9
  const std::int32_t in = 24, out = 40;
  const std::size_t bytes = sizeof(Real) * static_cast<std::size_t>(rows * stride);
  const Reserved space_x(bytes), space_y(bytes), space_d(bytes);
  if (!space_x.there() || !space_y.there() || !space_d.there())
    return run.absent("this system reserves no " + std::to_string(bytes >> 30) + " GiB of addresses");
  std::vector<Real> x(static_cast<std::size_t>(rows * in)), weight(static_cast<std::size_t>(in * out)), bias(out);
  for (std::size_t i = 0; i < x.size(); ++i) x[i] = static_cast<Real>(backend_index_number(i));
  for (std::size_t i = 0; i < weight.size(); ++i) weight[i] = static_cast<Real>(backend_index_number(1000 + i));
  for (std::size_t i = 0; i < bias.size(); ++i) bias[i] = static_cast<Real>(backend_index_number(9000 + i));
  const View<const Real> w(weight.data(), in, out), b(bias.data(), 1, out);
  std::vector<Real> y(static_cast<std::size_t>(rows * out)), dw(weight.size()), dw_far(weight.size()), db(bias.size()),
      db_far(bias.size());
  const auto forward = [&](View<const Real> from, View<Real> to) {
    apply(Layer<Real>{.x = from, .weight = w, .start = b, .relu = true, .y = to});
  };
  forward({x.data(), rows, in}, {y.data(), rows, out});
  const View<Real> x_far = spread(x, rows, in, stride, space_x.as<Real>());
  const View<Real> y_far(space_y.as<Real>(), rows, out, stride);
  forward(x_far, y_far);
  run.measure(differing<Real>(y_far, y), 0, "forward");
  std::vector<Real> dx(x.size()), weight_t(weight.size()), dy = y;
  transpose<Real>(w, {weight_t.data(), out, in});
  const auto backward = [&](View<const Real> dz, View<Real> to) {
    apply(Layer<Real>{.x = dz, .weight = View<const Real>(weight_t.data(), out, in), .exact = to});
  };
  const View<Real> dx_far(space_d.as<Real>(), rows, in, stride);
  const View<const Real> x_near(x.data(), rows, in), dy_near(dy.data(), rows, out);
  backward(dy_near, {dx.data(), rows, in});
  backward(y_far, dx_far);
  weight_gradient(x_near, dy_near, {dw.data(), in, out}, {db.data(), 1, out});
  weight_gradient(x_far, y_far, {dw_far.data(), in, out}, {db_far.data(), 1, out});
  run.measure(differing<Real>(dx_far, dx), 0, "input gradient");
  run.expect(dw == dw_far && db == db_far, "weight gradients");
  for (const IsaTable<Real>& table : isa_tables<Real>()) {
    std::vector<Real> c(y.size());
    Gemm<Real> g = product(rows, out, in, x.data(), weight.data(), c.data());
    table.kernels.gemm(g);
    g.a = x_far.data, g.a_row = stride;
    g.c = y_far.data, g.c_row = stride;
    table.kernels.gemm(g);
    run.measure(differing<Real>(y_far, c), 0, "product on " + std::string(isa_name(table.isa)));
  }
}

// The last samples of 1e5 rays x 256 samples, with 88 hidden channels each.
template <class Real>
void strided_compositing(CaseRun& run) {
  const std::int64_t samples = 25'600'000;
  const std::int32_t channels = 88, count = 12;
  const Reserved hidden = Reserved::of<Real>(samples * channels), rays = Reserved::of<std::int32_t>(samples);
  const Reserved columns[4] = {Reserved::of<Real>(samples), Reserved::of<Real>(samples), Reserved::of<Real>(samples),
                               Reserved::of<Real>(samples)};
  if (!hidden.there() || !columns[3].there() || !rays.there())
    return run.absent("this system reserves no addresses for them");
  const auto composite = [&](std::int64_t begin, std::int64_t rows, std::vector<Real>& out_hidden, Real& opacity) {
    std::int32_t first[2] = {static_cast<std::int32_t>(begin), static_cast<std::int32_t>(begin + count)};
    const View<Real> sigma(columns[0].as<Real>(), rows, 1), t(columns[1].as<Real>(), rows, 1),
        delta(columns[2].as<Real>(), rows, 1), weight(columns[3].as<Real>(), rows, 1),
        h(hidden.as<Real>(), rows, channels);
    for (std::int64_t k = begin; k < begin + count; ++k) {
      const auto n = static_cast<std::uint64_t>(k - begin);
      *sigma.row(k) = static_cast<Real>(1 + backend_index_number(n));
      *t.row(k) = static_cast<Real>(n);
      *delta.row(k) = Real(0.25);
      for (std::int32_t c = 0; c < channels; ++c)
        h(k, c) = static_cast<Real>(backend_index_number(100 * (n + 1) + static_cast<std::uint64_t>(c)));
    }
    Samples<Real> s{.t = t,
                    .delta = delta,
                    .ray_of_sample = View<std::int32_t>(rays.as<std::int32_t>(), rows, 1),
                    .first = View<std::int32_t>(first, 2, 1),
                    .count = rows};
    CompositeIn<Real> in{.samples = &s, .sigma = sigma, .hidden = h};
    CompositeOut<Real> out;
    out_hidden.assign(channels, Real(0));
    out.hidden = View<Real>(out_hidden.data(), 1, channels);
    out.opacity = View<Real>(&opacity, 1, 1);
    out.weight = weight;
    composite_forward(in, out);
  };
  std::vector<Real> near_hidden, far_hidden;
  Real near_opacity = 0, far_opacity = 0;
  composite(0, count, near_hidden, near_opacity);
  composite(samples - count, samples, far_hidden, far_opacity);
  run.expect(near_hidden == far_hidden && near_opacity == far_opacity && near_opacity > Real(0.5),
             "compositing at element 2.25e9 gives the same bits as at 0");
}

}  // namespace

void long_index(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    run.note(
        "addresses are reserved, not filled: strides of views, products, layers forward and backward, compositing, "
        "pixel numbers of the ray source");
    // 1e5 rays x 256 samples x 88 classes = 2.25e9 elements: sizes and offsets of views.
    const std::int64_t rows = 25'600'000;
    const Reserved space = Reserved::of<Real>(rows * 88);
    if (!space.there()) return run.absent("this system reserves no addresses for them");
    const View<Real> view(space.as<Real>(), rows, 88);
    run.expect(view.size() == 2'252'800'000 && view.size() > kTwo31, "a view counts 2,252,800,000 elements");
    run.expect(&view(rows - 1, 87) - view.data == view.size() - 1, "its last element is the last one");
    run.expect(view.row_range(rows - 3, 3).row(2) == view.row(rows - 1), "a range of rows at its end");
    run.expect(view.col_range(80, 8).row(rows - 1) == view.row(rows - 1) + 80, "a range of columns at its end");
    strided_products<Real>(run);
    strided_compositing<Real>(run);
  });
  // Pixels of a split are numbered up to 2^32; 15 frames of 2^28 pixels, of which the upper half lies beyond 2^31.
  run.row("-");
  StoredFrame frame;
  frame.width_px = frame.height_px = 16384;
  std::vector<TrainFrame> frames(15, TrainFrame{{}, &frame, nullptr});
  RaySourceOptions options{.train = {.rays = 3000}};
  const RaySource rays(frames, {}, {}, options);
  run.expect(rays.pixel_count() == 15 * (std::int64_t{1} << 28), "4,026,531,840 pixels");
  std::vector<int> drawn(15);
  double mean = 0;
  bool inside = true;
  for (std::int64_t ray = 0; ray < options.train.rays; ++ray) {
    const RaySource::Pixel pixel = rays.choose(1, ray);
    inside = inside && pixel.frame >= 0 && pixel.frame < 15 && pixel.index >= 0 && pixel.index < (1 << 28);
    if (!inside) break;
    ++drawn[pixel.frame];
    mean += pixel.index / static_cast<double>(options.train.rays) / (1 << 28);
  }
  run.expect(inside, "every pixel drawn lies in a frame");
  // 200 draws per frame: a binomial count is within 6 of its deviations of 13.7.
  for (const int count : drawn) run.near(count, 200, 6 * 13.7, "draws of a frame");
  run.near(mean, 0.5, 6 * 0.2887 / std::sqrt(3000.0), "mean place in a frame");
  frames.resize(17, frames[0]);
  run.expect_error(ErrorKind::data, {"more than 2^32 pixels"}, [&] { const RaySource more(frames, {}, {}, options); });
}

// I06: whole steps on every instruction set. The set is chosen when a program starts, so each gets a program of its
// own.

namespace {

struct Step {
  double loss = 0, norm = 0, oracle_loss = 0, oracle_norm = 0, psnr_db = 0;
  unsigned state = 0;
};

// The program beside this library, or in the folder of the tests.
std::string probe_path() {
  Dl_info info{};
  if (dladdr(reinterpret_cast<const void*>(&probe_path), &info) == 0 || info.dli_fname == nullptr) return {};
  const auto path = fs::path(info.dli_fname).parent_path() / "semfield_step_probe";
  return is_there(path) ? path.string() : std::string();
}

std::optional<Step> probe(CaseRun& run, const std::string& program, const std::string& set, const std::string& yaml,
                          int steps) {
  const std::string path = run.folder() + "/step.yaml";
  testing_room::plain_write(path, yaml);
  const std::string command = "SEMFIELD_ISA=" + set + " OMP_WAIT_POLICY=passive " + shell_word(program) + " " +
                              shell_word(path) + " " + std::to_string(steps);
  std::FILE* pipe = ::popen(command.c_str(), "r");  // NOLINT: nothing of it comes from outside
  if (pipe == nullptr) return {};
  char text[512] = "";
  const bool read = std::fgets(text, sizeof text, pipe) != nullptr;
  if (::pclose(pipe) != 0 || !read) return {};
  std::istringstream numbers(text);
  Step step;
  numbers >> step.loss >> step.norm >> step.oracle_loss >> step.oracle_norm >> step.psnr_db >> step.state;
  return numbers.fail() ? std::nullopt : std::optional(step);
}

}  // namespace

void whole_step(CaseRun& run) {
  run.row("fp32");
  const std::string program = probe_path();
  if (program.empty())
    return run.absent("the program that steps under another instruction set is not beside this library");
  const std::string scene = "scene: {type: box_room}\n";
  const auto runtime = [](const char* what) { return "runtime: {" + std::string(what) + "}\n"; };
  constexpr int kSteps = 100, kDeepSteps = 20;
  struct Measured {
    std::string set;
    Step step;
  };
  std::vector<Measured> hash, deep;
  const auto tables = isa_tables<float>();
  bool complete = true;
  const auto measured = [&](std::vector<Measured>& into, const std::string& set, const std::string& yaml, int steps) {
    const std::optional<Step> step = probe(run, program, set, yaml, steps);
    complete = complete && step.has_value();
    into.push_back({set, step.value_or(Step{})});
  };
  for (const IsaTable<float>& table : tables) {
    const std::string set(isa_name(table.isa));
    measured(hash, set, scene + kHashPass + runtime("threads: 1"), kSteps);
    measured(deep, set, scene + kFrequencyPass + runtime("threads: 1"), kDeepSteps);
  }
  std::vector<Measured> more;
  const std::string best(isa_name(isa()));
  measured(more, best, scene + kHashPass + runtime("threads: 3"), kSteps);
  measured(more, best, scene + kFrequencyPass + runtime("threads: 1, precision: bf16"), kDeepSteps);

  run.expect(complete, "every program ran to its end");
  double psnr = 0;
  for (const auto* kind : {&hash, &deep}) {
    for (const Measured& m : *kind) {
      // Against the same step in float64, and against the weakest set.
      run.relative(m.step.loss, m.step.oracle_loss, 1e-5, "loss on " + m.set);
      run.relative(m.step.norm, m.step.oracle_norm, 1e-4, "norm on " + m.set);
      run.relative(m.step.loss, kind->front().step.loss, 1e-5, "loss between sets");
      run.relative(m.step.norm, kind->front().step.norm, 1e-4, "norm between sets");
      psnr = std::max(psnr, std::abs(m.step.psnr_db - kind->front().step.psnr_db));
    }
  }
  run.measure(psnr, 0.05, "PSNR after training, dB");
  run.expect(hash.front().step.psnr_db > 15, "that training learned something");
  const unsigned state = hash.back().step.state;
  run.expect(more[0].step.state == state,
             "1 and 3 threads leave the same bits after " + std::to_string(kSteps) + " steps");
  std::string figures;
  for (const Measured& m : hash)
    figures += fmt::format("{}{} {:.3f} dB", figures.empty() ? "" : ", ", m.set, m.step.psnr_db);
  run.note(figures + " after " + std::to_string(kSteps) + " steps");

  run.row("float64");
  for (const auto* kind : {&hash, &deep}) {
    for (const Measured& m : *kind) {
      run.relative(m.step.oracle_loss, kind->front().step.oracle_loss, 1e-12, "loss");
      run.relative(m.step.oracle_norm, kind->front().step.oracle_norm, 1e-12, "norm");
    }
  }
  run.row("bf16");
  const Step& bf16 = more[1].step;
  run.expect(bf16.state != deep.back().step.state, "it is another arithmetic");
  // Products of 8 significant bits: 2^-8 a factor.
  run.relative(bf16.loss, bf16.oracle_loss, 0x1p-8, "loss");
  run.relative(bf16.norm, bf16.oracle_norm, 0x1p-4, "gradient norm");
  run.near(bf16.psnr_db, deep.back().step.psnr_db, 0.5, "PSNR after training, dB");
}

// I07: the checks for NaN and infinity are alive in the build that is shipped.

namespace {

// A word of the compiler's command line that removes such checks, "" for none.
std::string banned_flag(const std::string& commands) {
  for (const char* flag : {"-ffast-math", "-Ofast", "-ffinite-math-only", "-fno-honor-nans", "-menable-no-nans",
                           "-funsafe-math-optimizations", "--use_fast_math", "-ffp-model=fast", "-fassociative-math"}) {
    if (commands.find(flag) != std::string::npos) return flag;
  }
  return {};
}

// compile_commands.json in a folder above this library: the build's own record of how each file was compiled.
std::string compile_commands() {
  Dl_info info{};
  if (dladdr(reinterpret_cast<const void*>(&compile_commands), &info) == 0 || info.dli_fname == nullptr) return {};
  std::error_code ignored;
  fs::path folder = fs::absolute(info.dli_fname, ignored).parent_path();
  for (int up = 0; up < 4 && !folder.empty(); ++up, folder = folder.parent_path()) {
    if (is_file(folder / "compile_commands.json")) return read_text_file((folder / "compile_commands.json").string());
  }
  return {};
}

template <class Real>
void kernel_guards(CaseRun& run) {
  const Real nan = std::numeric_limits<Real>::quiet_NaN(), inf = std::numeric_limits<Real>::infinity();
  for (const Real bad : {nan, -nan, inf, -inf, std::numeric_limits<Real>::signaling_NaN()}) {
    std::vector<Real> values(100, Real(1));
    run.expect(all_finite(values.data(), 100) && first_non_finite<Real>({values.data(), 10, 10}) == -1,
               "sound numbers pass");
    values[63] = bad;
    run.expect(!all_finite(values.data(), 100), "all_finite sees it");
    run.expect(first_non_finite<Real>({values.data(), 10, 10}) == 63, "first_non_finite finds it");
    for (const IsaTable<Real>& table : isa_tables<Real>())
      run.expect(!table.kernels.all_finite(values.data(), 100), "all_finite on " + name_of(table.isa));
    testing::RayBuffers<Real> rays({3, 5}, 0);
    std::fill(rays.sigma.begin(), rays.sigma.end(), Real(1));
    check_density(rays.samples, View<const Real>(rays.col(rays.sigma)));
    rays.sigma[5] = bad;
    run.expect_error(ErrorKind::failure, {"ray 1", "sample 2"},
                     [&] { check_density(rays.samples, View<const Real>(rays.col(rays.sigma))); });
  }
}

std::uint32_t state_of(const Trainer& trainer) {
  std::uint32_t crc = 0;
  for (const TensorRef& tensor : trainer.tensors()) crc = crc32c(tensor.bytes, crc);
  return crc;
}

// Every dense tensor in turn gets one NaN: the step says so and changes nothing.
void trainer_guards(CaseRun& run) {
  Registry registry = with_room(run.registry());
  Session session = open_room(std::string("scene: {type: box_room}\n") + kHashPass, registry);
  int poisoned = 0;
  for (std::size_t i = 0; i < session.pipeline->store().all().size(); ++i) {
    // A network of its own for each: a run ends with such a step.
    session.pipeline = assemble(make_parts<float>(session.config, registry, session.plan, session.extent), {}, true);
    Tensor<float>& t = session.pipeline->store().all()[i];
    if (!t.learned() || t.spec.role == TensorRole::sparse) continue;
    Trainer trainer(session);
    trainer.advance();
    t.value.data()[0] = std::numeric_limits<float>::quiet_NaN();
    session.pipeline->derive(trainer.step());
    const std::uint32_t before = state_of(trainer);
    run.expect_error(ErrorKind::failure, {}, [&] { trainer.advance(); });
    run.expect(state_of(trainer) == before && trainer.step() == 1, "the step changed nothing: " + t.name);
    ++poisoned;
  }
  run.expect(poisoned > 5, "tensors were poisoned");
  run.note(std::to_string(poisoned) + " tensors of a network, each with a NaN");
}

}  // namespace

void finite_checks(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) { kernel_guards<Real>(run); });
  run.row("-");
#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
  run.expect(false, "this build assumes that numbers are finite");
#endif
  const std::string commands = compile_commands();
  if (commands.empty()) {
    run.note("no compile_commands.json above this library: its flags were not read");
  } else {
    run.expect(banned_flag(commands).empty(), "a flag of the fast-math family: " + banned_flag(commands));
    run.expect(!banned_flag("c++ -O3 -ffast-math -c a.cpp").empty(), "the search finds such a flag");
  }
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto bad = static_cast<float>(nan);
  Diagnostics quiet;
  Pose pose;
  pose.r[1][2] = nan;
  run.expect(check_pose(pose, "x", quiet) == PoseState::not_finite, "poses");
  Camera camera{4, 4, 4, 4, 2, 2};
  run.expect(check_camera(camera, "x", quiet), "a sound camera passes");
  camera.k2 = nan;
  run.expect(!check_camera(camera, "x", quiet), "cameras");
  ColorError color;
  color.add(std::vector<float>{1}, std::vector<float>{bad});
  DepthError depth;
  depth.add(std::vector<float>{1}, std::vector<float>{bad});
  Calibration calibration;
  calibration.add(std::vector<float>{bad}, std::vector<float>{bad}, std::vector<std::int16_t>{0},
                  std::vector<std::int16_t>{0});
  run.expect(color.nonfinite() == 1 && depth.nonfinite() == 1 && calibration.nonfinite() == 1, "metrics");
  SoftMap soft(2, 2);
  run.expect_error(ErrorKind::data, {}, [&] { soft.set_row(1, std::vector<float>{0.5F, bad}); });
  const std::vector<float> weights{1, bad};
  run.expect_error(ErrorKind::data, {"holds NaN"},
                   [&] { (void)TensorFile::decode(encode_safetensors({tensor_ref("w", {2}, weights)}, {}), "f", {}); });
  run.expect_error(ErrorKind::data, {"not a number"}, [&] {
    (void)marching_cubes({{0, 0, 0}, 1, 2, 2, 2}, 0.5,
                         [&](std::int64_t, std::span<double> values) { std::fill(values.begin(), values.end(), nan); });
  });
  if (raycast_available()) {
    const std::string path = run.folder() + "/nan.obj";
    testing_room::plain_write(path, "v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n");
    run.expect_error(ErrorKind::data, {"not a finite number"}, [&] { (void)load_obj(path, quiet); });
  }
  Registry registry = with_room(run.registry());
  run.expect_error(ErrorKind::config, {".nan"}, [&] {
    (void)open_room(std::string("scene: {type: box_room}\n") + kHashPass + "report: {eval_every_s: .nan}\n", registry);
  });
  trainer_guards(run);
}

// I01 to I05 and the kernels' part of I07 on a device beside the CPU, one call of a plugin at a time.

namespace {

constexpr std::int64_t kRows = 40;

// An encoder on the device, and as one on the host with its tensors.
struct DeviceEncoder {
  DeviceEncoder(const DeviceUnderTest& device, const std::string& name, const testkit::Settings& settings)
      : there(testkit::make_part<float>(device.registry, name, settings, EncoderBuild{.device = Device::cuda})),
        here(testkit::host_twin(*there, {device.calls, false}), device.calls.memory) {}
  std::vector<float> forward(const std::vector<double>& x) { return here.forward(x); }
  std::unique_ptr<Encoder<float>> there;
  testkit::EncoderBox<float> here;
};

struct Kind {
  const char* name;
  testkit::Settings settings;
};
const std::vector<Kind>& kinds() {
  static const std::vector<Kind> all{
      {"identity", {}},
      {"frequency", {{"frequencies", "10"}}},
      {"hash_grid", {{"levels", "4"}, {"log2_entries", "9"}, {"base_resolution", "4"}, {"finest_resolution", "32"}}}};
  return all;
}

std::vector<double> positions(std::int64_t rows) {
  Numbers numbers(31);
  std::vector<double> x(static_cast<std::size_t>(3 * rows));
  for (double& v : x) v = numbers.in(0.02, 0.98);
  return x;
}

// A field whose first trunk layers meet NaN in one row: it stays in that row, and no ReLU hides it.
void nan_through_a_field(CaseRun& run, const DeviceUnderTest& device, const std::string& name, Precision precision) {
  FieldBuild build{.device = Device::cuda, .position_dims = 16, .direction_dims = 9, .precision = precision};
  const auto there = testkit::make_part<float>(device.registry, name, {}, build);
  const std::unique_ptr<Field<float>> here = testkit::host_twin(*there, {device.calls, false});
  testkit::LawOptions options{.scratch = device.calls.memory};
  testkit::FieldBench<float> sound(*here, build, kRows, 0, options), bad(*here, build, kRows, 0, options);
  constexpr std::int64_t kBad = 17;
  bad.position(kBad, 3) = std::numeric_limits<float>::quiet_NaN();
  sound.forward();
  bad.forward();
  const std::string on = " of " + name + (precision == Precision::bf16 ? " in bf16" : "");
  bool alone = true;
  for (std::int64_t m = 0; m < kRows; ++m) {
    if (m == kBad) continue;
    alone = alone && bad.sigma(m, 0) == sound.sigma(m, 0) && bad.rgb(m, 1) == sound.rgb(m, 1);
  }
  run.expect(alone, "a NaN keeps to its row" + on);
  run.expect(std::isnan(bad.sigma(kBad, 0)) && std::isnan(bad.rgb(kBad, 1)), "no ReLU hides it" + on);
}

}  // namespace

std::optional<DeviceUnderTest> device_row(CaseRun& run, std::string_view precision) {
  run.row(precision);
  std::string why_not = "this build has no CUDA kernels";
  if (!has_cuda_library() || !cuda_available(&why_not)) {
    run.absent(why_not);
    return {};
  }
  DeviceUnderTest device{run.registry(), cuda_library().calls};
  cuda_library().add_kernels(device.registry.kernels());
  return device;
}

void nan_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  for (const char* name : {"tiny_mlp", "nerf_mlp"}) {
    for (const Precision precision : {Precision::fp32, Precision::bf16})
      nan_through_a_field(run, *device, name, precision);
  }
}

void fused_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  const double u = std::numeric_limits<float>::epsilon() / 2;
  for (const Kind& kind : kinds()) {
    DeviceEncoder there(*device, kind.name, kind.settings);
    testkit::EncoderBox<float> here(run.registry(), kind.name, kind.settings);
    const std::vector<double> x = positions(2000);
    const std::vector<float> a = there.forward(x), b = here.forward(x);
    const testkit::Difference off =
        testkit::difference<float, float>({a.data(), std::ssize(a), 1}, {b.data(), std::ssize(b), 1});
    run.measure(off.max_abs / off.max_want / u, 4, std::string(kind.name) + ", in u of the largest value");
  }
}

void subnormals_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  DeviceEncoder identity(*device, "identity", {});
  std::vector<double> x;
  for (int i = 0; i < 600; ++i) x.push_back((i % 2 == 0 ? 1 : -1) * 0x1p-120 * std::pow(0.9, i));
  const std::vector<float> y = identity.forward(x);
  int subnormal = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    run.near(y[i], static_cast<float>(x[i]), 0, "a number that becomes subnormal");
    subnormal += std::fpclassify(y[i]) == FP_SUBNORMAL ? 1 : 0;
  }
  run.expect(subnormal > 100, "subnormal numbers were among them");
}

void sines_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  const DeviceEncoder encoder(*device, "frequency", sine_settings());
  run.measure(worst_sine<float>(encoder.here.encoder()), 2, "sin and cos, in units of the last place of 1");
}

// Rows of the result lie 600 million elements apart in device memory; only they are brought back.
void long_index_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  constexpr std::int64_t kFew = 5, kStride = 600'000'000;
  const std::vector<double> x = positions(kFew);
  Workspace arena(device->calls.memory);
  std::byte* const given = arena.take_bytes(x.size() * sizeof(double));
  device->calls.to_device(x.data(), given, x.size() * sizeof(double));
  std::byte* far = nullptr;
  try {
    far = arena.take_bytes(static_cast<std::size_t>(kFew * kStride) * sizeof(float));
  } catch (const Error& error) {
    return run.absent(error.message());
  }
  for (const char* name : {"identity", "frequency"}) {  // without tensors
    DeviceEncoder encoder(*device, name, {});
    const std::int32_t cols = encoder.here.out_dims();
    const std::vector<float> near = encoder.forward(x);
    const View<float> y(reinterpret_cast<float*>(far), kFew, cols, kStride, Device::cuda);
    const View<const double> x_there(reinterpret_cast<const double*>(given), kFew, 3, 3, Device::cuda);
    device->calls.run(false, [&] { encoder.there->forward(encoder.here.context(), {}, x_there, y); });
    std::vector<float> row(static_cast<std::size_t>(cols));
    for (std::int64_t r = 0; r < kFew; ++r) {
      device->calls.to_host(reinterpret_cast<const std::byte*>(y.row(r)), row.data(), row.size() * sizeof(float));
      run.expect(std::memcmp(row.data(), near.data() + r * cols, row.size() * sizeof(float)) == 0,
                 std::string(name) + ": rows up to element 2.4e9 have the bits of packed ones");
    }
  }
}

void encoder_guards_on_device(CaseRun& run, const DeviceUnderTest& device) {
  const double inf = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  for (const Kind& kind : kinds()) {
    DeviceEncoder encoder(device, kind.name, kind.settings);
    for (const std::size_t row : {0, 31, 32, 39}) {
      for (const double bad : {nan, -nan, inf, -inf}) {
        std::vector<double> x = positions(kRows);
        x[3 * row + row % 3] = bad;
        run.expect_error(ErrorKind::data, {std::string("encoder '") + kind.name + "'", std::to_string(row)},
                         [&] { (void)encoder.forward(x); });
      }
    }
  }
}

// I06 and I07 on a device beside the CPU: whole steps, and their guards.

namespace {

// A room that trains where its configuration says.
struct Training {
  Training(const std::string& yaml, const std::string& runtime, Registry& registry)
      : session(open_room("scene: {type: box_room}\n" + yaml + "runtime: {" + runtime + "}\n", registry)),
        trainer(session) {}
  StepLosses train(std::int64_t steps) {
    StepLosses last;
    while (trainer.step() < steps) last = trainer.advance(steps - trainer.step()).back();
    trainer.collect();
    return last;
  }
  double psnr_db() {
    return evaluate(*session.pipeline, session.eval_job({0, 1, 2}), session.limits, session.plan.class_of_logit)
        .color.psnr_db()
        .value_or(std::nan(""));
  }
  // Of the gradient, after the first step: Adam's first moment is then (1 - beta1) times it.
  long double gradient_norm() const {
    long double squares = 0;
    for (const Tensor<float>& t : session.pipeline->store().all()) {
      for (std::int64_t i = 0; t.learned() && i < t.size(); ++i)
        squares += long_double(t.moment1.data()[i]) * t.moment1.data()[i];
    }
    return std::sqrt(squares) / (1 - session.config.adam.beta1);
  }
  Session session;
  Trainer trainer;
};

struct Network {
  const char* yaml;
  const char* tile;  // the batch as one, as a device takes it: rays of both have the same numbers
  std::int64_t steps;
};
const Network kNetworks[] = {{kHashPass, ", tile_rays: 192", 100}, {kFrequencyPass, ", tile_rays: 128", 20}};

void step_in(CaseRun& run, Registry& registry, bool bf16) {
  for (const Network& network : kNetworks) {
    Training cpu(network.yaml, std::string("device: cpu") + network.tile, registry);
    Training cuda(network.yaml, std::string("device: cuda") + network.tile + (bf16 ? ", precision: bf16" : ""),
                  registry);
    const double want = cpu.train(1).total, got = cuda.train(1).total;
    // In bf16 products of 8 significant bits; all as on the CPU's own rows.
    run.relative(got, want, bf16 ? 0x1p-8 : 1e-5, "loss of a step");
    run.relative(cuda.gradient_norm(), cpu.gradient_norm(), bf16 ? 0x1p-4 : 1e-4, "gradient norm");
    cpu.train(network.steps);
    cuda.train(network.steps);
    const double there = cuda.psnr_db(), here = cpu.psnr_db();
    run.near(there, here, bf16 ? 0.5 : 0.05, "PSNR after training, dB");
    run.note(fmt::format("{:.3f} dB after {} steps, {:.3f} dB on the CPU", there, network.steps, here));
  }
}

}  // namespace

void whole_step_on_device(CaseRun& run) {
  for (const bool bf16 : {false, true}) {
    const std::optional<DeviceUnderTest> device = device_row(run, bf16 ? "bf16 on cuda" : "fp32 on cuda");
    if (!device) continue;
    Registry registry = with_room(run.registry());
    step_in(run, registry, bf16);
  }
}

// Every dense tensor in turn gets one NaN: the step says so and changes nothing.
void finite_checks_on_device(CaseRun& run) {
  const std::optional<DeviceUnderTest> device = device_row(run);
  if (!device) return;
  encoder_guards_on_device(run, *device);
  Registry registry = with_room(run.registry());
  const std::size_t tensors = Training(kHashPass, "device: cuda", registry).session.pipeline->store().all().size();
  int poisoned = 0;
  for (std::size_t i = 0; i < tensors; ++i) {
    Training one(kHashPass, "device: cuda", registry);  // a run ends with such a step
    Tensor<float>& t = one.session.pipeline->store().all()[i];
    if (!t.learned() || t.spec.role == TensorRole::sparse) continue;
    one.train(1);
    t.value.data()[0] = std::numeric_limits<float>::quiet_NaN();
    one.session.pipeline->executor().upload(1);
    const std::uint32_t before = state_of(one.trainer);
    run.expect_error(ErrorKind::failure, {}, [&] { one.trainer.advance(); });
    one.trainer.collect();
    run.expect(state_of(one.trainer) == before && one.trainer.step() == 1, "the step changed nothing: " + t.name);
    ++poisoned;
  }
  run.expect(poisoned > 5, "tensors were poisoned");
  run.note(std::to_string(poisoned) + " tensors of a network, each with a NaN");
}

}  // namespace semfield::numerics
