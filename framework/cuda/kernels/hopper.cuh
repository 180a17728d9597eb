// Instructions of Hopper (compute capability 9.0) that C++ has no words for: barriers in shared memory that count
// bytes, bulk copies, and matrix products of a warpgroup (4 warps) with operands in shared memory [PTX 9]. Only code of
// CPUs that have them may call these.
#pragma once

#include <cuda_bf16.h>

#include <cstdint>

namespace semfield::cuda::hopper {

inline constexpr int kWarpgroup = 128;

__device__ inline std::uint32_t shared_address(const void* pointer) {
  return static_cast<std::uint32_t>(__cvta_generic_to_shared(pointer));
}

// Barriers: 8 bytes of shared memory. A phase ends when all arrivals and all announced bytes have come; `parity` is the
// phase's number modulo 2.
__device__ inline void barrier_init(std::uint32_t barrier, std::uint32_t arrivals) {
  asm volatile("mbarrier.init.shared::cta.b64 [%0], %1;" ::"r"(barrier), "r"(arrivals) : "memory");
}
/// Makes initialised barriers known to the copy engine and to the cluster; a block or cluster barrier must follow.
__device__ inline void fence_barrier_init() { asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory"); }
/// One arrival that announces `bytes`.
__device__ inline void barrier_expect(std::uint32_t barrier, std::uint32_t bytes) {
  asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(barrier), "r"(bytes) : "memory");
}
__device__ inline void barrier_arrive(std::uint32_t barrier) {
  asm volatile("mbarrier.arrive.shared::cta.b64 _, [%0];" ::"r"(barrier) : "memory");
}
/// Arrival at the barrier at the same place in block `rank` of the cluster. Says that operands were read, publishes no
/// writes: released to the cluster it would be a memory barrier of several hundred cycles.
__device__ inline void barrier_arrive_at(std::uint32_t barrier, std::uint32_t rank) {
  asm volatile(
      "{\n.reg .b32 remote;\nmapa.shared::cluster.u32 remote, %0, %1;\n"
      "mbarrier.arrive.shared::cluster.b64 _, [remote];\n}\n" ::"r"(barrier),
      "r"(rank)
      : "memory");
}
/// Waits for the end of the phase of this parity.
__device__ inline void barrier_wait(std::uint32_t barrier, std::uint32_t parity) {
  std::uint32_t done = 0;
  do {
    asm volatile(
        "{\n.reg .pred p;\nmbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2;\n"
        "selp.u32 %0, 1, 0, p;\n}\n"
        : "=r"(done)
        : "r"(barrier), "r"(parity)
        : "memory");
  } while (done == 0);
}

__device__ inline std::uint32_t cluster_rank() {
  std::uint32_t rank;
  asm volatile("mov.u32 %0, %%cluster_ctarank;" : "=r"(rank));
  return rank;
}
/// All threads of the cluster.
__device__ inline void cluster_barrier() {
  asm volatile("barrier.cluster.arrive.release;\nbarrier.cluster.wait.acquire;" ::: "memory");
}
/// `threads` threads of the block that name the same barrier, 1 to 15.
__device__ inline void named_barrier(int name, int threads) {
  asm volatile("barrier.sync %0, %1;" ::"r"(name), "r"(threads) : "memory");
}

// Bulk copies: addresses and sizes are multiples of 16 bytes.
__device__ inline void bulk_load(std::uint32_t to, const void* from, std::uint32_t bytes, std::uint32_t barrier) {
  asm volatile("cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1], %2, [%3];" ::"r"(to),
               "l"(from), "r"(bytes), "r"(barrier)
               : "memory");
}
/// To the same place of every block of the cluster in `mask`, and counted by their barriers at the same place.
__device__ inline void bulk_load_to_all(std::uint32_t to, const void* from, std::uint32_t bytes, std::uint32_t barrier,
                                        std::uint16_t mask) {
  asm volatile(
      "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes.multicast::cluster [%0], [%1], %2, [%3], "
      "%4;" ::"r"(to),
      "l"(from), "r"(bytes), "r"(barrier), "h"(mask)
      : "memory");
}
__device__ inline void bulk_store(void* to, std::uint32_t from, std::uint32_t bytes) {
  asm volatile("cp.async.bulk.global.shared::cta.bulk_group [%0], [%1], %2;\ncp.async.bulk.commit_group;" ::"l"(to),
               "r"(from), "r"(bytes)
               : "memory");
}
/// Waits until this thread's bulk stores have read shared memory.
__device__ inline void bulk_stores_have_read() { asm volatile("cp.async.bulk.wait_group.read 0;" ::: "memory"); }
__device__ inline void bulk_stores_are_done() { asm volatile("cp.async.bulk.wait_group 0;" ::: "memory"); }
/// This thread's writes to shared memory become visible to bulk copies and matrix products; a barrier must follow.
__device__ inline void fence_shared_writes() { asm volatile("fence.proxy.async.shared::cta;" ::: "memory"); }

__device__ inline uint4 load_shared(std::uint32_t address) {
  uint4 value;
  asm volatile("ld.shared.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(value.x), "=r"(value.y), "=r"(value.z), "=r"(value.w)
               : "r"(address)
               : "memory");
  return value;
}
/// Four 8 x 8 matrices of bf16 to shared memory: lane l gives the address of row l % 8 of matrix l / 8.
__device__ inline void store_matrices(std::uint32_t address, std::uint32_t m0, std::uint32_t m1, std::uint32_t m2,
                                      std::uint32_t m3) {
  asm volatile("stmatrix.sync.aligned.m8n8.x4.shared.b16 [%0], {%1, %2, %3, %4};" ::"r"(address), "r"(m0), "r"(m1),
               "r"(m2), "r"(m3)
               : "memory");
}
/// Two numbers as bf16, the first in the lower half.
__device__ inline std::uint32_t pack(float first, float second) {
  const __nv_bfloat162 both = __floats2bfloat162_rn(first, second);
  std::uint32_t bits;
  memcpy(&bits, &both, sizeof bits);
  return bits;
}

/// The same of what is above 0, else 0; NaN stays NaN.
__device__ inline std::uint32_t pack_positive(float first, float second) {
  std::uint32_t bits;
  asm("cvt.rn.relu.bf16x2.f32 %0, %1, %2;" : "=r"(bits) : "f"(second), "f"(first));
  return bits;
}
/// Each half of 16 bits full of its highest bit.
__device__ inline std::uint32_t spread_signs(std::uint32_t halves) {
  std::uint32_t bits;
  asm("prmt.b32 %0, %1, 0, 0xBB99;" : "=r"(bits) : "r"(halves));
  return bits;
}

template <int kRegisters>
__device__ inline void more_registers() {
  asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(kRegisters));
}
template <int kRegisters>
__device__ inline void fewer_registers() {
  asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(kRegisters));
}

/// An operand of a warpgroup's product: 8 x 8 blocks of bf16 of 128 contiguous bytes each, whose rows run along the
/// terms (or along the operand's rows, then the product transposes it). term_step, row_step: bytes from a block to the
/// next one along the terms and along the operand's rows.
__device__ inline std::uint64_t operand(std::uint32_t address, std::uint32_t term_step, std::uint32_t row_step) {
  const auto field = [](std::uint32_t bytes) { return static_cast<std::uint64_t>((bytes & 0x3FFFFu) >> 4); };
  return field(address) | field(term_step) << 16 | field(row_step) << 32;
}
__device__ inline void wgmma_fence() { asm volatile("wgmma.fence.sync.aligned;" ::: "memory"); }
__device__ inline void wgmma_commit() { asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory"); }
/// Waits until at most kPending groups of products are unfinished.
template <int kPending>
__device__ inline void wgmma_wait() {
  asm volatile("wgmma.wait_group.sync.aligned %0;" ::"n"(kPending) : "memory");
}

#define SEMFIELD_ACCUMULATORS_4(acc, i) "+f"(acc[i]), "+f"(acc[(i) + 1]), "+f"(acc[(i) + 2]), "+f"(acc[(i) + 3])
#define SEMFIELD_ACCUMULATORS_16(acc, i)                                                                         \
  SEMFIELD_ACCUMULATORS_4(acc, i), SEMFIELD_ACCUMULATORS_4(acc, (i) + 4), SEMFIELD_ACCUMULATORS_4(acc, (i) + 8), \
      SEMFIELD_ACCUMULATORS_4(acc, (i) + 12)
#define SEMFIELD_ACCUMULATORS_64(acc)                                                                     \
  SEMFIELD_ACCUMULATORS_16(acc, 0), SEMFIELD_ACCUMULATORS_16(acc, 16), SEMFIELD_ACCUMULATORS_16(acc, 32), \
      SEMFIELD_ACCUMULATORS_16(acc, 48)
#define SEMFIELD_ACCUMULATORS_128(acc)                                                                 \
  SEMFIELD_ACCUMULATORS_64(acc), SEMFIELD_ACCUMULATORS_16(acc, 64), SEMFIELD_ACCUMULATORS_16(acc, 80), \
      SEMFIELD_ACCUMULATORS_16(acc, 96), SEMFIELD_ACCUMULATORS_16(acc, 112)

/// acc += A B^T for 64 rows, 256 columns and 16 terms, or = with accumulate false; both operands in shared memory.
template <bool kTransposeA = false, bool kTransposeB = false>
__device__ inline void wgmma(float (&acc)[128], std::uint64_t a, std::uint64_t b, bool accumulate) {
  asm volatile(
      "{\n.reg .pred p;\nsetp.ne.b32 p, %130, 0;\n"
      "wgmma.mma_async.sync.aligned.m64n256k16.f32.bf16.bf16 {"
      "%0, %1, %2, %3, %4, %5, %6, %7, %8, %9, %10, %11, %12, %13, %14, %15, "
      "%16, %17, %18, %19, %20, %21, %22, %23, %24, %25, %26, %27, %28, %29, %30, %31, "
      "%32, %33, %34, %35, %36, %37, %38, %39, %40, %41, %42, %43, %44, %45, %46, %47, "
      "%48, %49, %50, %51, %52, %53, %54, %55, %56, %57, %58, %59, %60, %61, %62, %63, "
      "%64, %65, %66, %67, %68, %69, %70, %71, %72, %73, %74, %75, %76, %77, %78, %79, "
      "%80, %81, %82, %83, %84, %85, %86, %87, %88, %89, %90, %91, %92, %93, %94, %95, "
      "%96, %97, %98, %99, %100, %101, %102, %103, %104, %105, %106, %107, %108, %109, %110, %111, "
      "%112, %113, %114, %115, %116, %117, %118, %119, %120, %121, %122, %123, %124, %125, %126, %127"
      "}, %128, %129, p, 1, 1, %131, %132;\n}\n"
      : SEMFIELD_ACCUMULATORS_128(acc)
      : "l"(a), "l"(b), "r"(static_cast<std::int32_t>(accumulate)), "n"(static_cast<int>(kTransposeA)),
        "n"(static_cast<int>(kTransposeB)));
}
/// acc += A B^T for 64 rows, 128 columns and 16 terms, or = with accumulate false; both operands in shared memory.
template <bool kTransposeA = false, bool kTransposeB = false>
__device__ inline void wgmma(float (&acc)[64], std::uint64_t a, std::uint64_t b, bool accumulate) {
  asm volatile(
      "{\n.reg .pred p;\nsetp.ne.b32 p, %66, 0;\n"
      "wgmma.mma_async.sync.aligned.m64n128k16.f32.bf16.bf16 {"
      "%0, %1, %2, %3, %4, %5, %6, %7, %8, %9, %10, %11, %12, %13, %14, %15, "
      "%16, %17, %18, %19, %20, %21, %22, %23, %24, %25, %26, %27, %28, %29, %30, %31, "
      "%32, %33, %34, %35, %36, %37, %38, %39, %40, %41, %42, %43, %44, %45, %46, %47, "
      "%48, %49, %50, %51, %52, %53, %54, %55, %56, %57, %58, %59, %60, %61, %62, %63"
      "}, %64, %65, p, 1, 1, %67, %68;\n}\n"
      : SEMFIELD_ACCUMULATORS_64(acc)
      : "l"(a), "l"(b), "r"(static_cast<std::int32_t>(accumulate)), "n"(static_cast<int>(kTransposeA)),
        "n"(static_cast<int>(kTransposeB)));
}

#undef SEMFIELD_ACCUMULATORS_4
#undef SEMFIELD_ACCUMULATORS_16
#undef SEMFIELD_ACCUMULATORS_64
#undef SEMFIELD_ACCUMULATORS_128

}  // namespace semfield::cuda::hopper
