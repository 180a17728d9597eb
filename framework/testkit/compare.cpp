// Comparison of matrices.
#include "testkit/compare.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>

#include "testkit/failures.h"

namespace semfield::testkit {

namespace {
std::string number(double value) {
  char text[40];
  std::snprintf(text, sizeof(text), "%.9g", value);
  return text;
}
std::string element(std::int64_t row, std::int32_t col) {
  std::string text = "element (";
  text += std::to_string(row);
  text += ", ";
  text += std::to_string(col);
  text += ")";
  return text;
}
}  // namespace

std::string to_text(const Failures& failures) {
  std::string text;
  for (const std::string& failure : failures) text += failure + "\n";
  return text;
}

template <class A, class B>
Difference difference(View<const A> got, View<const B> want) {
  Difference worst;
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const double a = static_cast<double>(got(r, c));
      const double b = static_cast<double>(want(r, c));
      double gap = std::abs(a - b);
      if (!std::isfinite(a) || !std::isfinite(b)) gap = std::numeric_limits<double>::infinity();
      if (std::isfinite(b)) worst.max_want = std::max(worst.max_want, std::abs(b));
      if (gap > worst.max_abs) {
        worst.max_abs = gap;
        worst.row = r;
        worst.col = c;
        worst.got = a;
        worst.want = b;
      }
    }
  }
  return worst;
}

template <class A, class B>
std::string compare(View<const A> got, View<const B> want, double tolerance, double floor) {
  const Difference worst = difference(got, want);
  const double allowed = tolerance * std::max(worst.max_want, floor);
  if (worst.max_abs <= allowed) return {};
  return element(worst.row, worst.col) + " is " + number(worst.got) + ", expected " + number(worst.want) + " (off by " +
         number(worst.max_abs) + ", allowed " + number(allowed) + ")";
}

template <class A, class B>
std::string compare_norms(View<const A> got, View<const B> want, double tolerance) {
  double off = 0, all = 0;
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const double b = static_cast<double>(want(r, c)), d = static_cast<double>(got(r, c)) - b;
      off += d * d;
      all += b * b;
    }
  }
  if (std::sqrt(off) <= tolerance * std::sqrt(all)) return {};
  return "differs by " + number(std::sqrt(off)) + " in norm, allowed " + number(tolerance * std::sqrt(all));
}

template <class A>
std::string compare_bits(View<const A> got, View<const A> want) {
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const A a = got(r, c);
      const A b = want(r, c);
      if (std::memcmp(&a, &b, sizeof(A)) != 0) {
        return element(r, c) + " is " + number(static_cast<double>(a)) + ", expected the same bits as " +
               number(static_cast<double>(b));
      }
    }
  }
  return {};
}

template Difference difference(View<const float>, View<const float>);
template Difference difference(View<const float>, View<const double>);
template Difference difference(View<const double>, View<const double>);
template std::string compare(View<const float>, View<const float>, double, double);
template std::string compare(View<const float>, View<const double>, double, double);
template std::string compare(View<const double>, View<const double>, double, double);
template std::string compare_norms(View<const float>, View<const float>, double);
template std::string compare_norms(View<const float>, View<const double>, double);
template std::string compare_bits(View<const float>, View<const float>);
template std::string compare_bits(View<const double>, View<const double>);
template std::string compare_bits(View<const std::int32_t>, View<const std::int32_t>);

}  // namespace semfield::testkit
