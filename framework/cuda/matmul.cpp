#include "cuda/matmul.h"

#include <cublasLt.h>

#include <algorithm>
#include <compare>
#include <map>
#include <mutex>
#include <optional>
#include <string>

#include "core/error.h"
#include "cuda/launch.h"

namespace semfield::cuda {

namespace {

constexpr std::size_t kWorkspaceBytes = std::size_t{64} << 20;
constexpr std::uint32_t kMostAlignment = 256;

void check_lt(cublasStatus_t status, const char* what) {
  if (status == CUBLAS_STATUS_SUCCESS) return;
  throw Error(ErrorKind::failure, "device.cublas.failed",
              std::string("cuBLASLt: ") + what + ": " + cublasLtGetStatusString(status) + " (" +
                  cublasLtGetStatusName(status) + ")",
              "");
}

std::uint32_t alignment_of(const void* pointer) {
  const auto address = reinterpret_cast<std::uintptr_t>(pointer);
  return address == 0 ? kMostAlignment
                      : static_cast<std::uint32_t>(std::min<std::uintptr_t>(kMostAlignment, address & (~address + 1)));
}

cudaDataType_t type_of(Element element) { return element == Element::fp32 ? CUDA_R_32F : CUDA_R_16BF; }

// By Epilogue.
constexpr cublasLtEpilogue_t kEpilogues[] = {CUBLASLT_EPILOGUE_DEFAULT, CUBLASLT_EPILOGUE_BIAS, CUBLASLT_EPILOGUE_RELU,
                                             CUBLASLT_EPILOGUE_RELU_BIAS};

// cuBLASLt thinks in columns: our row-major D = A B is its D^T = B^T A^T, so its first operand is our B.
struct Problem {
  cublasLtMatmulDescOpaque_t call;
  cublasLtMatrixLayoutOpaque_t first, second, result;

  explicit Problem(const Product& p) {
    const auto layout = [](cublasLtMatrixLayoutOpaque_t& l, const Matrix& m) {
      check_lt(cublasLtMatrixLayoutInit(&l, type_of(m.type), static_cast<std::uint64_t>(m.cols),
                                        static_cast<std::uint64_t>(m.rows), m.stride),
               "describing a matrix");
    };
    layout(first, p.b);
    layout(second, p.a);
    layout(result, p.d);
    const cublasComputeType_t arithmetic = p.tf32 ? CUBLAS_COMPUTE_32F_FAST_TF32 : CUBLAS_COMPUTE_32F;
    check_lt(cublasLtMatmulDescInit(&call, arithmetic, CUDA_R_32F), "describing a product");
    set(CUBLASLT_MATMUL_DESC_TRANSA, p.b.transposed ? CUBLAS_OP_T : CUBLAS_OP_N);
    set(CUBLASLT_MATMUL_DESC_TRANSB, p.a.transposed ? CUBLAS_OP_T : CUBLAS_OP_N);
    set(CUBLASLT_MATMUL_DESC_EPILOGUE, kEpilogues[static_cast<std::size_t>(p.epilogue)]);
    if (p.bias != nullptr) set(CUBLASLT_MATMUL_DESC_BIAS_POINTER, p.bias);
  }

 private:
  template <class T>
  void set(cublasLtMatmulDescAttributes_t attribute, const T& value) {
    check_lt(cublasLtMatmulDescSetAttribute(&call, attribute, &value, sizeof value), "describing a product");
  }
};

struct MatrixKey {
  std::int64_t rows, cols, stride;
  Element type;
  bool transposed;
  std::uint32_t alignment;
  auto operator<=>(const MatrixKey&) const = default;
};
MatrixKey key_of(const Matrix& m) { return {m.rows, m.cols, m.stride, m.type, m.transposed, alignment_of(m.data)}; }

/// All that the choice of an algorithm depends on.
struct ProductKey {
  MatrixKey a, b, d;
  bool add, tf32;
  Epilogue epilogue;
  std::uint32_t bias_alignment;
  auto operator<=>(const ProductKey&) const = default;
};

class Library {
 public:
  Library() { check_lt(cublasLtCreate(&handle_), "starting"); }

  /// The algorithm of a product, found at its first call; none: there is no kernel.
  std::optional<cublasLtMatmulAlgo_t> algorithm(const Product& p, Problem& problem) {
    const ProductKey key{key_of(p.a), key_of(p.b), key_of(p.d), p.add, p.tf32, p.epilogue, alignment_of(p.bias)};
    const std::lock_guard lock(mutex_);
    const auto known = algorithms_.find(key);
    if (known != algorithms_.end()) return known->second;
    return algorithms_.emplace(key, choose(key, problem)).first->second;
  }

  cublasLtHandle_t handle() const { return handle_; }
  /// Of this thread's stream, which gets it with its first product.
  std::byte* workspace() {
    const std::lock_guard lock(mutex_);
    Buffer<std::byte>& own = workspaces_[launch().stream];
    if (own.size() == 0) own = Buffer<std::byte>(kWorkspaceBytes, "workspace of matrix products");
    return own.data();
  }
  void forget(cudaStream_t stream) {
    const std::lock_guard lock(mutex_);
    workspaces_.erase(stream);
  }

 private:
  std::optional<cublasLtMatmulAlgo_t> choose(const ProductKey& key, Problem& problem) const {
    cublasLtMatmulPreferenceOpaque_t preference;
    check_lt(cublasLtMatmulPreferenceInit(&preference), "stating a preference");
    const auto set = [&](cublasLtMatmulPreferenceAttributes_t attribute, const auto& value) {
      check_lt(cublasLtMatmulPreferenceSetAttribute(&preference, attribute, &value, sizeof value),
               "stating a preference");
    };
    set(CUBLASLT_MATMUL_PREF_MAX_WORKSPACE_BYTES, kWorkspaceBytes);
    // Of the ways to split a sum over blocks, only those that add the parts in order, in fp32.
    set(CUBLASLT_MATMUL_PREF_REDUCTION_SCHEME_MASK, static_cast<std::uint32_t>(CUBLASLT_REDUCTION_SCHEME_COMPUTE_TYPE));
    set(CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_A_BYTES, key.b.alignment);
    set(CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_B_BYTES, key.a.alignment);
    set(CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_C_BYTES, key.d.alignment);
    set(CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_D_BYTES, key.d.alignment);
    cublasLtMatmulHeuristicResult_t best{};
    int found = 0;
    const cublasStatus_t status =
        cublasLtMatmulAlgoGetHeuristic(handle_, &problem.call, &problem.first, &problem.second, &problem.result,
                                       &problem.result, &preference, 1, &best, &found);
    if (status != CUBLAS_STATUS_SUCCESS || found == 0 || best.state != CUBLAS_STATUS_SUCCESS) return std::nullopt;
    return best.algo;
  }

  cublasLtHandle_t handle_ = nullptr;
  std::mutex mutex_;
  std::map<cudaStream_t, Buffer<std::byte>> workspaces_;
  std::map<ProductKey, std::optional<cublasLtMatmulAlgo_t>> algorithms_;
};

// By device. Never destroyed: at the end of a process the driver may be gone before it.
struct Libraries {
  std::mutex mutex;
  std::map<int, Library*> of_device;
};
Libraries& libraries() {
  static Libraries* const all = new Libraries;
  return *all;
}

// Of the launch's device.
Library& library() {
  const std::lock_guard lock(libraries().mutex);
  Library*& found = libraries().of_device[launch().ordinal];
  if (found == nullptr) found = new Library;
  return *found;
}

}  // namespace

void forget_stream(cudaStream_t stream) {
  const std::lock_guard lock(libraries().mutex);
  for (const auto& [ordinal, each] : libraries().of_device) each->forget(stream);
}

bool product(const Product& p) {
  if (p.d.rows == 0 || p.d.cols == 0) return true;
  const std::int64_t terms = p.a.transposed ? p.a.rows : p.a.cols;
  if (terms > 0) {
    Problem problem(p);
    Library& lt = library();
    if (const std::optional<cublasLtMatmulAlgo_t> algorithm = lt.algorithm(p, problem)) {
      const float one = 1, start = p.add ? 1 : 0;
      check_lt(cublasLtMatmul(lt.handle(), &problem.call, &one, p.b.data, &problem.first, p.a.data, &problem.second,
                              &start, p.d.data, &problem.result, p.d.data, &problem.result, &*algorithm, lt.workspace(),
                              kWorkspaceBytes, launch().stream),
               "a product");
      return true;
    }
  }
  if (p.tf32) {
    Product exact = p;
    exact.tf32 = false;
    return product(exact);
  }
  if (p.epilogue != Epilogue::none) return false;
  simple_product(p);
  return true;
}

}  // namespace semfield::cuda
