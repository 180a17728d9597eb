// Matrix products by oneDNN 2 or 3. Its primitives have fixed shapes, are made once and then reused; so products are
// cut into blocks of fixed size, the last one filled up with zeros, and a row's bits do not depend on where it stands.
#include <algorithm>
#include <compare>
#include <cstring>
#include <dnnl.hpp>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include "compute/foreign_call.h"
#include "compute/gemm_engine.h"
#include "compute/parallel.h"

namespace semfield {
namespace {

using dnnl::memory;

constexpr std::int64_t kRows = 64;    // of C, a block of x W or dY W^T
constexpr std::int64_t kDepth = 256;  // of the sum, a block of X^T dY

/// A is [m, k], or stored as [k, m] when transposed; A and, when bf16, B lie without gaps.
struct Shape {
  std::int64_t m, n, k, b_row, c_row;
  bool transposed = false, accumulate = false, bias = false, relu = false, bf16 = false;
  auto operator<=>(const Shape&) const = default;
};

std::uint16_t bf16_of(float value) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  if ((bits & 0x7F800000u) == 0x7F800000u) return static_cast<std::uint16_t>((bits >> 16) | ((bits & 0xFFFFu) != 0));
  return static_cast<std::uint16_t>((bits + 0x7FFFu + ((bits >> 16) & 1u)) >> 16);
}

/// rows x cols of `from` without gaps, zero rows up to `all_rows`, in buffer.
const void* packed(const float* from, std::int64_t stride, std::int64_t rows, std::int64_t cols, std::int64_t all_rows,
                   bool bf16, float* buffer) {
  auto* const narrow = reinterpret_cast<std::uint16_t*>(buffer);
  for (std::int64_t i = 0; i < rows; ++i) {
    const float* row = from + i * stride;
    if (bf16) {
      for (std::int64_t j = 0; j < cols; ++j) narrow[i * cols + j] = bf16_of(row[j]);
    } else {
      std::copy_n(row, cols, buffer + i * cols);
    }
  }
  const std::size_t size = bf16 ? sizeof(std::uint16_t) : sizeof(float);
  std::memset(reinterpret_cast<std::byte*>(buffer) + static_cast<std::size_t>(rows * cols) * size, 0,
              static_cast<std::size_t>((all_rows - rows) * cols) * size);
  return buffer;
}

/// Memory that the products of one place share, since they run one at a time. What grows is replaced and the old memory
/// kept by those who have it, so that a product that runs meanwhile is not disturbed.
struct Buffer {
  std::shared_ptr<float[]> data;
  std::int64_t size = 0;
  std::shared_ptr<float[]> of_size(std::int64_t need) {
    if (need > size) {
      data = std::make_shared<float[]>(static_cast<std::size_t>(need));
      size = need;
    }
    return data;
  }
};

/// What one thread at a time needs for products.
struct Place {
  dnnl::engine engine{dnnl::engine::kind::cpu, 0};
  dnnl::stream stream{engine};
  Buffer a, b, c;     // copies of operands
  KeptBlocks blocks;  // of lists that oneDNN makes of its arguments at every call
};

/// A primitive with its arguments and scratchpad.
class Product {
 public:
  Product(const Shape& s, Place& place) : shape_(s), place_(place) {
    const dnnl::engine& engine = place.engine;
    const auto in = s.bf16 ? memory::data_type::bf16 : memory::data_type::f32;
    const memory::desc a({s.m, s.k}, in, s.transposed ? memory::dims{1, s.m} : memory::dims{s.k, 1});
    const memory::desc b({s.k, s.n}, in, memory::dims{s.b_row, 1});
    const memory::desc c({s.m, s.n}, memory::data_type::f32, memory::dims{s.c_row, 1});
    const memory::desc bias({1, s.n}, memory::data_type::f32, memory::dims{s.n, 1});
    dnnl::primitive_attr attr;
    dnnl::post_ops after;
    if (s.accumulate) after.append_sum(1.0F);
    if (s.relu) append_relu(after);
    attr.set_post_ops(after);
    attr.set_scratchpad_mode(dnnl::scratchpad_mode::user);
#if DNNL_VERSION_MAJOR < 3
    const auto desc = s.bias ? dnnl::matmul::desc(a, b, bias, c) : dnnl::matmul::desc(a, b, c);
    const dnnl::matmul::primitive_desc primitive(desc, attr, engine);
#else
    const auto primitive = s.bias ? dnnl::matmul::primitive_desc(engine, a, b, bias, c, attr)
                                  : dnnl::matmul::primitive_desc(engine, a, b, c, attr);
#endif
    matmul_ = dnnl::matmul(primitive);
    const auto argument = [&](int which, const memory& what) {
      memories_.push_back(what);
      arguments_.push_back({which, what.get()});
    };
    argument(DNNL_ARG_SRC, memory(a, engine, nullptr));
    argument(DNNL_ARG_WEIGHTS, memory(b, engine, nullptr));
    argument(DNNL_ARG_DST, memory(c, engine, nullptr));
    argument(DNNL_ARG_SCRATCHPAD, memory(primitive.scratchpad_desc(), engine));
    if (s.bias) argument(DNNL_ARG_BIAS, memory(bias, engine, nullptr));
    a_ = place.a.of_size(s.m * s.k);
    b_ = place.b.of_size(s.k * s.n);
    c_ = place.c.of_size(s.transposed ? 0 : s.m * s.c_row);
    // What the library makes at a primitive's first call is made here, not in a step.
    std::vector<float> any(static_cast<std::size_t>(std::max({s.m * s.k, s.k * s.b_row, s.m * s.c_row})));
    std::vector<float> result(any.size());
    execute(any.data(), any.data(), result.data(), s.bias ? any.data() : nullptr);
  }

  void forward(const Gemm<float>& g) {
    const Shape& s = shape_;
    const void* b = s.bf16 ? packed(g.b, g.b_row, g.k, g.n, g.k, true, b_.get()) : g.b;
    for (std::int64_t row = 0; row < g.m; row += kRows) {
      const std::int64_t rows = std::min(kRows, g.m - row);
      float* c = g.c + row * g.c_row;
      for (std::int64_t i = 0; g.row_term != nullptr && i < rows; ++i) {
        const std::int64_t from = g.row_of != nullptr ? g.row_of[(row + i) * g.row_of_stride] : row + i;
        std::copy_n(g.row_term + from * g.row_term_stride, g.n, c + i * g.c_row);
      }
      const void* a = packed(g.a + row * g.a_row, g.a_row, rows, g.k, kRows, s.bf16, a_.get());
      if (rows == kRows) {
        execute(a, b, c, g.bias);
      } else {
        std::fill_n(c_.get(), kRows * g.c_row, 0.0F);
        const auto copy = [&](const float* from, float* to) {
          for (std::int64_t i = 0; i < rows; ++i) std::copy_n(from + i * g.c_row, g.n, to + i * g.c_row);
        };
        if (s.accumulate) copy(c, c_.get());
        execute(a, b, c_.get(), g.bias);
        copy(c_.get(), c);
      }
      for (std::int64_t i = 0; g.mask != nullptr && i < rows; ++i) {
        const float* keep = g.mask + (row + i) * g.mask_row;
        for (std::int64_t j = 0; j < g.n; ++j) c[i * g.c_row + j] = keep[j] > 0 ? c[i * g.c_row + j] : 0.0F;
      }
    }
  }

  void weight_gradient(const Gemm<float>& g) {
    for (std::int64_t k = 0; k < g.k; k += kDepth) {
      const std::int64_t depth = std::min(kDepth, g.k - k);
      const void* a = packed(g.a + k * g.a_col, g.a_col, depth, g.m, kDepth, shape_.bf16, a_.get());
      const void* b = packed(g.b + k * g.b_row, g.b_row, depth, g.n, kDepth, shape_.bf16, b_.get());
      execute(a, b, g.c, nullptr);
    }
  }

 private:
  static void append_relu(dnnl::post_ops& after) {
#if DNNL_VERSION_MAJOR < 3
    after.append_eltwise(1.0F, dnnl::algorithm::eltwise_relu, 0.0F, 0.0F);
#else
    after.append_eltwise(dnnl::algorithm::eltwise_relu, 0.0F, 0.0F);
#endif
  }

  /// By the C interface: that of C++ makes a list of the arguments at every call.
  void execute(const void* a, const void* b, float* c, const float* bias) {
    memories_[0].set_data_handle(const_cast<void*>(a));
    memories_[1].set_data_handle(const_cast<void*>(b));
    memories_[2].set_data_handle(c);
    if (bias != nullptr) memories_[4].set_data_handle(const_cast<float*>(bias));
    const ForeignCall call(place_.blocks);
    dnnl::error::wrap_c_api(dnnl_primitive_execute(matmul_.get(), place_.stream.get(),
                                                   static_cast<int>(arguments_.size()), arguments_.data()),
                            "a matrix product of oneDNN failed");
  }

  Shape shape_;
  Place& place_;
  dnnl::matmul matmul_;
  std::vector<memory> memories_;  // of SRC, WEIGHTS, DST, SCRATCHPAD, BIAS
  std::vector<dnnl_exec_arg_t> arguments_;
  std::shared_ptr<float[]> a_, b_, c_;
};

/// The products of the process. A shape that is asked for the first time is made for every thread at once, so that a
/// thread that comes to it in a later step makes nothing.
class Products {
 public:
  void run(const Shape& shape, const Gemm<float>& g) {
    const Loan loan(*this, shape);
    if (shape.transposed) {
      loan.product->weight_gradient(g);
    } else {
      loan.product->forward(g);
    }
  }

 private:
  struct Loan {
    Loan(Products& all, const Shape& shape) : lender(all) {
      const std::lock_guard<std::mutex> lock(lender.mutex_);
      const std::size_t wanted = std::max(lender.places_.size(), static_cast<std::size_t>(thread_count()));
      lender.grow(lender.idle_.empty() ? std::max(wanted, lender.places_.size() + 1) : wanted, shape);
      place = lender.idle_.back();
      lender.idle_.pop_back();
      product = lender.of_shape_[shape][place].get();
    }
    ~Loan() {
      const std::lock_guard<std::mutex> lock(lender.mutex_);
      lender.idle_.push_back(place);
    }
    Loan(const Loan&) = delete;
    Loan& operator=(const Loan&) = delete;
    Products& lender;
    std::size_t place;
    Product* product;
  };

  void grow(std::size_t places, const Shape& shape) {
    of_shape_.try_emplace(shape);
    idle_.reserve(places);
    for (; places_.size() < places; places_.push_back(std::make_unique<Place>())) idle_.push_back(places_.size());
    for (auto& [each, products] : of_shape_) {
      while (products.size() < places) products.push_back(std::make_unique<Product>(each, *places_[products.size()]));
    }
  }

  std::mutex mutex_;
  std::vector<std::unique_ptr<Place>> places_;
  std::vector<std::size_t> idle_;
  std::map<Shape, std::vector<std::unique_ptr<Product>>> of_shape_;
};

bool run(const Gemm<float>& g) {
  if (g.m == 0 || g.n == 0 || g.k == 0) return false;
  const bool transposed = g.a_row == 1 && g.a_col != 1;
  if (!transposed && g.a_col != 1) return false;
  if (transposed && (!g.accumulate || g.relu || g.mask != nullptr)) return false;
#if DNNL_VERSION_MAJOR >= 3
  // Version 3.7 writes a single column as if there were no gaps between its rows.
  if (g.n == 1 && g.c_row != 1) return false;
#endif
  thread_local const bool serial = (keep_libraries_serial(), true);
  static_cast<void>(serial);
  static Products products;
  const bool bf16 = g.precision == Precision::bf16;
  Shape s{.m = kRows, .n = g.n, .k = g.k, .b_row = bf16 ? g.n : g.b_row, .c_row = g.c_row, .bf16 = bf16};
  if (transposed) {
    s.m = g.m;
    s.k = kDepth;
    s.b_row = g.n;
    s.transposed = s.accumulate = true;
  } else {
    s.accumulate = g.accumulate || g.row_term != nullptr;
    s.bias = g.bias != nullptr;
    s.relu = g.relu;
  }
  products.run(s, g);
  return true;
}

std::string version() {
  const dnnl_version_t& v = *dnnl::version();
  return "oneDNN " + std::to_string(v.major) + "." + std::to_string(v.minor) + "." + std::to_string(v.patch);
}

}  // namespace
}  // namespace semfield

extern "C" semfield::OnednnGemm semfield_onednn_gemm() { return {semfield::run, semfield::version}; }
