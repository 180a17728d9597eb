// I05: arithmetic of indices beyond 2^31 elements. Addresses are reserved, memory is not: rows stand hundreds of
// millions of elements apart, and only the pages that they touch are ever filled.
#include <sys/mman.h>

#include <cstring>

#include "backend_parts.h"
#include "compute/layers.h"
#include "core/rng.h"
#include "model/compositor.h"
#include "session/ray_source.h"

namespace semfield::numerics {

namespace {

constexpr std::int64_t kTwo31 = std::int64_t{1} << 31;

// Addresses of `bytes` bytes; a page gets memory when it is written.
class Reserved {
 public:
  explicit Reserved(std::size_t bytes)
      : bytes_(bytes),
        memory_(::mmap(nullptr, bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0)) {}
  ~Reserved() {
    if (there()) ::munmap(memory_, bytes_);
  }
  Reserved(const Reserved&) = delete;
  Reserved& operator=(const Reserved&) = delete;
  bool there() const { return memory_ != MAP_FAILED; }
  template <class T>
  T* as() const {
    return static_cast<T*>(memory_);
  }

 private:
  std::size_t bytes_;
  void* memory_;
};

double number(std::uint64_t index) {
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
  for (std::size_t i = 0; i < x.size(); ++i) x[i] = static_cast<Real>(number(i));
  for (std::size_t i = 0; i < weight.size(); ++i) weight[i] = static_cast<Real>(number(1000 + i));
  for (std::size_t i = 0; i < bias.size(); ++i) bias[i] = static_cast<Real>(number(9000 + i));
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
    Gemm<Real> g;
    g.m = rows, g.n = out, g.k = in;
    g.b = weight.data(), g.b_row = out;
    g.a = x.data(), g.a_row = in;
    g.c = c.data(), g.c_row = out;
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
  const Reserved hidden(sizeof(Real) * static_cast<std::size_t>(samples * channels));
  const Reserved rgb(sizeof(Real) * static_cast<std::size_t>(3 * samples));
  const Reserved columns[4] = {Reserved(sizeof(Real) * static_cast<std::size_t>(samples)),
                               Reserved(sizeof(Real) * static_cast<std::size_t>(samples)),
                               Reserved(sizeof(Real) * static_cast<std::size_t>(samples)),
                               Reserved(sizeof(Real) * static_cast<std::size_t>(samples))};
  const Reserved rays(sizeof(std::int32_t) * static_cast<std::size_t>(samples));
  if (!hidden.there() || !rgb.there() || !columns[3].there() || !rays.there())
    return run.absent("this system reserves no addresses for them");
  const auto composite = [&](std::int64_t begin, std::int64_t rows, std::vector<Real>& out_hidden, Real& opacity) {
    std::int32_t first[2] = {static_cast<std::int32_t>(begin), static_cast<std::int32_t>(begin + count)};
    const View<Real> sigma(columns[0].as<Real>(), rows, 1), t(columns[1].as<Real>(), rows, 1),
        delta(columns[2].as<Real>(), rows, 1), weight(columns[3].as<Real>(), rows, 1),
        h(hidden.as<Real>(), rows, channels);
    for (std::int64_t k = begin; k < begin + count; ++k) {
      const auto n = static_cast<std::uint64_t>(k - begin);
      *sigma.row(k) = static_cast<Real>(1 + number(n));
      *t.row(k) = static_cast<Real>(n);
      *delta.row(k) = Real(0.25);
      for (std::int32_t c = 0; c < channels; ++c)
        h(k, c) = static_cast<Real>(number(100 * (n + 1) + static_cast<std::uint64_t>(c)));
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
    const Reserved space(sizeof(Real) * static_cast<std::size_t>(rows) * 88);
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
  for (const int count : drawn) run.measure(std::abs(count - 200), 6 * 13.7, "draws of a frame");
  run.measure(std::abs(mean - 0.5), 6 * 0.2887 / std::sqrt(3000.0), "mean place in a frame");
  frames.resize(17, frames[0]);
  run.expect_error(ErrorKind::data, {"more than 2^32 pixels"}, [&] { const RaySource more(frames, {}, {}, options); });
}

}  // namespace semfield::numerics
