// Matrix products by oneDNN. Its primitives have fixed shapes, are made once a thread and shape and then reused; so
// products are cut into blocks of fixed size, the last one filled up with zeros, and a row's bits do not depend on
// where it stands.
#include <algorithm>
#include <compare>
#include <cstring>
#include <dnnl.hpp>
#include <map>
#include <string>
#include <unordered_map>
#include <vector>

#include "core/gemm_engine.h"
#include "core/parallel.h"

namespace semfield {
namespace {

using dnnl::memory;

constexpr std::int64_t kRows = 64;    // of C, a block of x W or dY W^T
constexpr std::int64_t kDepth = 256;  // of the sum, a block of X^T dY

/// A is [m, k], or stored as [k, m] when transposed; A and, when bf16, B lie without gaps.
struct Shape {
  std::int64_t m, n, k, b_row, c_row;
  bool transposed, accumulate, bias, relu, bf16;
  auto operator<=>(const Shape&) const = default;
};

class Product {
 public:
  Product(const Shape& s, const dnnl::engine& engine, const dnnl::stream& stream) : stream_(&stream) {
    const auto in = s.bf16 ? memory::data_type::bf16 : memory::data_type::f32;
    const memory::desc a({s.m, s.k}, in, s.transposed ? memory::dims{1, s.m} : memory::dims{s.k, 1});
    const memory::desc b({s.k, s.n}, in, memory::dims{s.b_row, 1});
    const memory::desc c({s.m, s.n}, memory::data_type::f32, memory::dims{s.c_row, 1});
    const memory::desc bias({1, s.n}, memory::data_type::f32, memory::dims{s.n, 1});
    dnnl::primitive_attr attr;
    dnnl::post_ops after;
    if (s.accumulate) after.append_sum(1.0F);
    if (s.relu) after.append_eltwise(1.0F, dnnl::algorithm::eltwise_relu, 0.0F, 0.0F);
    attr.set_post_ops(after);
    attr.set_scratchpad_mode(dnnl::scratchpad_mode::user);
    const auto desc = s.bias ? dnnl::matmul::desc(a, b, bias, c) : dnnl::matmul::desc(a, b, c);
    const dnnl::matmul::primitive_desc primitive(desc, attr, engine);
    matmul_ = dnnl::matmul(primitive);
    const auto borrowed = [&](const memory::desc& what) { return memory(what, engine, nullptr); };
    arguments_ = {{DNNL_ARG_SRC, borrowed(a)},
                  {DNNL_ARG_WEIGHTS, borrowed(b)},
                  {DNNL_ARG_DST, borrowed(c)},
                  {DNNL_ARG_SCRATCHPAD, memory(primitive.scratchpad_desc(), engine)}};
    if (s.bias) arguments_[DNNL_ARG_BIAS] = borrowed(bias);
  }

  void run(const void* a, const void* b, float* c, const float* bias) {
    arguments_.at(DNNL_ARG_SRC).set_data_handle(const_cast<void*>(a));
    arguments_.at(DNNL_ARG_WEIGHTS).set_data_handle(const_cast<void*>(b));
    arguments_.at(DNNL_ARG_DST).set_data_handle(c);
    if (bias != nullptr) arguments_.at(DNNL_ARG_BIAS).set_data_handle(const_cast<float*>(bias));
    matmul_.execute(*stream_, arguments_);
  }

 private:
  const dnnl::stream* stream_;
  dnnl::matmul matmul_;
  std::unordered_map<int, memory> arguments_;
};

std::uint16_t bf16_of(float value) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  if ((bits & 0x7F800000u) == 0x7F800000u) return static_cast<std::uint16_t>((bits >> 16) | ((bits & 0xFFFFu) != 0));
  return static_cast<std::uint16_t>((bits + 0x7FFFu + ((bits >> 16) & 1u)) >> 16);
}

/// One thread's primitives and copies of operands; buffers keep their capacity.
class Thread {
 public:
  Thread() : engine_(dnnl::engine::kind::cpu, 0), stream_(engine_) { keep_libraries_serial(); }

  void forward(const Gemm<float>& g) {
    Shape s{kRows,
            g.n,
            g.k,
            g.b_row,
            g.c_row,
            false,
            g.accumulate || g.row_term != nullptr,
            g.bias != nullptr,
            g.relu,
            g.precision == Precision::bf16};
    const void* b = g.b;
    if (s.bf16) {
      b = packed(g.b, g.b_row, g.k, g.n, g.k, true, b_);
      s.b_row = g.n;
    }
    for (std::int64_t row = 0; row < g.m; row += kRows) {
      const std::int64_t rows = std::min(kRows, g.m - row);
      float* c = g.c + row * g.c_row;
      for (std::int64_t i = 0; g.row_term != nullptr && i < rows; ++i) {
        const std::int64_t from = g.row_of != nullptr ? g.row_of[(row + i) * g.row_of_stride] : row + i;
        std::copy_n(g.row_term + from * g.row_term_stride, g.n, c + i * g.c_row);
      }
      const void* a = packed(g.a + row * g.a_row, g.a_row, rows, g.k, kRows, s.bf16, a_);
      if (rows == kRows) {
        product(s).run(a, b, c, g.bias);
      } else {
        Shape part = s;
        part.c_row = g.n;
        c_.assign(static_cast<std::size_t>(kRows * g.n), 0.0F);
        for (std::int64_t i = 0; s.accumulate && i < rows; ++i) std::copy_n(c + i * g.c_row, g.n, c_.data() + i * g.n);
        product(part).run(a, b, c_.data(), g.bias);
        for (std::int64_t i = 0; i < rows; ++i) std::copy_n(c_.data() + i * g.n, g.n, c + i * g.c_row);
      }
      for (std::int64_t i = 0; g.mask != nullptr && i < rows; ++i) {
        const float* keep = g.mask + (row + i) * g.mask_row;
        for (std::int64_t j = 0; j < g.n; ++j) c[i * g.c_row + j] = keep[j] > 0 ? c[i * g.c_row + j] : 0.0F;
      }
    }
  }

  void weight_gradient(const Gemm<float>& g) {
    const Shape s{g.m, g.n, kDepth, g.n, g.c_row, true, true, false, false, g.precision == Precision::bf16};
    for (std::int64_t k = 0; k < g.k; k += kDepth) {
      const std::int64_t depth = std::min(kDepth, g.k - k);
      const void* a = packed(g.a + k * g.a_col, g.a_col, depth, g.m, kDepth, s.bf16, a_);
      const void* b = packed(g.b + k * g.b_row, g.b_row, depth, g.n, kDepth, s.bf16, b_);
      product(s).run(a, b, g.c, nullptr);
    }
  }

 private:
  Product& product(const Shape& shape) { return products_.try_emplace(shape, shape, engine_, stream_).first->second; }

  /// rows x cols of `from` without gaps, zero rows up to `all_rows`, in buffer.
  static const void* packed(const float* from, std::int64_t stride, std::int64_t rows, std::int64_t cols,
                            std::int64_t all_rows, bool bf16, std::vector<float>& buffer) {
    const std::size_t need = static_cast<std::size_t>(all_rows * cols);
    if (buffer.size() < need) buffer.resize(need);
    auto* const narrow = reinterpret_cast<std::uint16_t*>(buffer.data());
    for (std::int64_t i = 0; i < rows; ++i) {
      const float* row = from + i * stride;
      if (bf16) {
        for (std::int64_t j = 0; j < cols; ++j) narrow[i * cols + j] = bf16_of(row[j]);
      } else {
        std::copy_n(row, cols, buffer.data() + i * cols);
      }
    }
    const std::size_t size = bf16 ? sizeof(std::uint16_t) : sizeof(float);
    std::memset(reinterpret_cast<std::byte*>(buffer.data()) + static_cast<std::size_t>(rows * cols) * size, 0,
                static_cast<std::size_t>((all_rows - rows) * cols) * size);
    return buffer.data();
  }

  dnnl::engine engine_;
  dnnl::stream stream_;
  std::map<Shape, Product> products_;
  std::vector<float> a_, b_, c_;
};

bool run(const Gemm<float>& g) {
  if (g.m == 0 || g.n == 0 || g.k == 0) return false;
  const bool transposed = g.a_row == 1 && g.a_col != 1;
  if (!transposed && g.a_col != 1) return false;
  if (transposed && (!g.accumulate || g.relu || g.mask != nullptr)) return false;
  thread_local Thread thread;
  if (transposed) {
    thread.weight_gradient(g);
  } else {
    thread.forward(g);
  }
  return true;
}

std::string version() {
  const dnnl_version_t& v = *dnnl::version();
  return "oneDNN " + std::to_string(v.major) + "." + std::to_string(v.minor) + "." + std::to_string(v.patch);
}

}  // namespace
}  // namespace semfield

extern "C" semfield::OnednnGemm semfield_onednn_gemm() { return {semfield::run, semfield::version}; }
