// Cases C12 to C14: gradients of the hash grid.
#include <fmt/format.h>

#include "hash_reference.h"
#include "thread_scope.h"

namespace semfield::numerics {

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
      for (const Real g : dy) want += static_cast<long double>(g);
      for (std::int64_t r = 0; r < box.tensors().grad(0).rows; ++r) {
        for (int f = 0; f < 2; ++f) got += static_cast<long double>(box.tensors().grad(0)(r, f));
      }
      const std::uint64_t vertex[3] = {8, 8, 8};
      const std::int64_t entry = reference_entry(16, box.tensors().grad(0).rows, vertex);
      for (int f = 0; f < 2; ++f) lost += box.tensors().grad(0)(entry, f) == Real(0) ? 1 : 0;
      run.expect(lost == 0, "no gradient is flushed");
      // 1,024 additions of one sign to an entry round by 6e-5 of it at worst; a tenth is allowed. Beside it, a product
      // of a gradient and a corner's weight counts as 0 below the least normal number: 1e-38, which 1e-36 comes near.
      const double flushed =
          8.0 * static_cast<double>(dy.size()) * static_cast<double>(std::numeric_limits<Real>::min());
      run.measure(relative_error(got, want), tolerance_of<Real>(6e-6) + flushed / static_cast<double>(want),
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
      want[i % 2] += static_cast<long double>(dy.back());
      mass[i % 2] += std::abs(static_cast<long double>(dy.back()));
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
      run.measure(static_cast<double>(std::abs(static_cast<long double>(first[f]) - want[f]) / mass[f]),
                  tolerance_of<Real>(2e-7), "sum");
    run.note("100 repeats on 1 and 2 threads: the same bits");
  });
}

void hash_gradient(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
          for (std::size_t i = 0; i < y.size(); ++i)
            sum += static_cast<long double>(y[i]) * static_cast<long double>(dy[i]);
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
          const long double near = (at[2] - at[1]) / static_cast<long double>(moved[2] - moved[1]);
          const long double wide = (at[3] - at[0]) / static_cast<long double>(moved[3] - moved[0]);
          run.measure(static_cast<double>(std::abs(static_cast<long double>(dx[i]) - (4 * near - wide) / 3)) / largest,
                      std::is_same_v<Real, float> ? 2e-6 : 1e-7, "by coordinates");
        }
        const View<Real> grad = box.tensors().grad(0);
        const View<double> value = oracle.tensors().value(0);
        double scale = 0;
        for (std::int64_t i = 0; i < grad.size(); ++i) scale = std::max<double>(scale, std::abs(grad.data[i]));
        for (std::int64_t i = 0; i < grad.size(); ++i) {
          if (i % 7 != 0 && grad.data[i] == Real(0))
            continue;  // every entry with a gradient, and a seventh of the rest
          const double keep = value.data[i];
          value.data[i] = keep + 1;  // linear in the table: any step will do
          const long double up = loss();
          value.data[i] = keep - 1;
          const long double down = loss();
          value.data[i] = keep;
          run.measure(static_cast<double>(std::abs(static_cast<long double>(grad.data[i]) - (up - down) / 2)) / scale,
                      std::is_same_v<Real, float> ? 2e-6 : 1e-7, "by entries");
        }
      }
    }
  });
}

}  // namespace semfield::numerics
