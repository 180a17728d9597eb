// A plugin that breaks one promise, and the law that must say so.
#pragma once

#include <gtest/gtest.h>

#include <cctype>
#include <string>

namespace semfield {

template <class Break>
struct BrokenCase {
  Break broken;
  const char* law;  ///< words of its sentence
};

/// "5_every_dx_written": the name of a test of such a case.
struct NameOfCase {
  template <class Case>
  std::string operator()(const testing::TestParamInfo<Case>& info) const {
    std::string name = std::to_string(info.index) + "_" + info.param.law;
    for (char& c : name) c = std::isalnum(static_cast<unsigned char>(c)) != 0 ? c : '_';
    return name;
  }
};

}  // namespace semfield
