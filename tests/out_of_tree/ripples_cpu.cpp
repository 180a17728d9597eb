// Kernels of 'ripples' for CPUs: compiled once per instruction set.
#include "compute/isa.h"
#include "plugin/kernels.h"
#include "ripples_kernels.h"

#define RIPPLES_TEXT_OF(name) #name
#define RIPPLES_TEXT(name) RIPPLES_TEXT_OF(name)

namespace semfield::SEMFIELD_ISA {

void ripples_cpu_kernels(KernelTables& tables);

namespace {

template <class Real>
void forward(View<const double> x, View<Real> y) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    const double s = outside::ripples_phase(x.row(r), x.cols);
    for (std::int32_t b = 0; b < y.cols; ++b) y(r, b) = static_cast<Real>(std::cos((b + 1) * s));
  }
}

template <class Real>
void backward(View<const double> x, View<const Real> dy, View<Real> dx) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    const double s = outside::ripples_phase(x.row(r), x.cols);
    double slope = 0;
    for (std::int32_t b = 0; b < dy.cols; ++b) slope -= static_cast<double>(dy(r, b)) * (b + 1) * std::sin((b + 1) * s);
    for (std::int32_t d = 0; d < dx.cols; ++d) dx(r, d) = static_cast<Real>(slope);
  }
}

template <class Real>
constexpr outside::RipplesKernels<Real> kTable{forward<Real>, backward<Real>, RIPPLES_TEXT(SEMFIELD_ISA)};

}  // namespace

void ripples_cpu_kernels(KernelTables& tables) {
  tables.add(Device::cpu, "encoder 'ripples'", &kTable<float>);
  tables.add(Device::cpu, "encoder 'ripples'", &kTable<double>);
}

}  // namespace semfield::SEMFIELD_ISA
