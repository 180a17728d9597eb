// Cases C08 to C11: faces, continuity, resolutions and addresses of the hash grid.
#include <fmt/format.h>

#include "hash_reference.h"
#include "plugins/encoders/hash_grid/hash_grid_kernels.h"
#include "testkit/field_bench.h"

namespace semfield::numerics {

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
    const long double error = std::abs(static_cast<long double>(y[i]) - want);
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
        for (const Real sum : y) run.measure(std::abs(static_cast<double>(sum) - 1), tolerance_of<Real>(2e-7), "sum w");
        std::vector<Real> dx(x.size());
        box.encoder().backward(box.context(), tensors, {x.data(), rows, 3}, {dy.data(), rows, features},
                               {dx.data(), rows, 3});
        run.expect(grads.broken_guard().empty(), "gradients stay inside the table");
        long double spread = 0;
        for (std::int64_t r = 0; r < spec.rows; ++r) spread += static_cast<long double>(grad(r, 0));
        run.measure(relative_error(spread, rows), tolerance_of<Real>(2e-6), "gradient handed to the table");
      }
    }
  });
}

void hash_continuity(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
  });
}

void hash_resolution(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
  });
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
    make_encoder<float>(run.registry(), "hash_grid", one_level(n, 24), build)->declare(collector);
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

}  // namespace semfield::numerics
