// What a text or a refusal says, where a test checks its meaning: the code, the place and the values found, in any
// words.
#pragma once

#include <gtest/gtest.h>

#include <initializer_list>

#include "core/error.h"
#include "core/text.h"

namespace semfield {

inline constexpr std::size_t kShown = 4000;  ///< of a text, in a failure: pages are long

/// "" when `text` holds every one of `parts`; else the first that it does not hold, and the text.
inline std::string unsaid(std::string_view text, std::initializer_list<std::string_view> parts) {
  for (const std::string_view part : parts) {
    if (text.find(part) == std::string_view::npos)
      return "no '" + std::string(part) + "' in '" + std::string(text.substr(0, kShown)) + "'";
  }
  return "";
}

/// "" when one of `findings` has the code and holds every one of `parts`; else what there is.
inline std::string unfound(const std::vector<Diagnostic>& findings, Code code,
                           std::initializer_list<std::string_view> parts) {
  std::string there;
  for (const Diagnostic& finding : findings) {
    if (finding.code == code && unsaid(finding.text(), parts).empty()) return "";
    there += "\n" + finding.shown();
  }
  std::string wanted = code.text();
  for (const std::string_view part : parts) wanted += ", '" + std::string(part) + "'";
  return "no finding with " + wanted + (there.empty() ? std::string(": there are none") : " among" + there);
}

/// Every finding as it is shown, a line each.
inline std::string all_said(const Diagnostics& diagnostics) {
  std::string out;
  for (const Diagnostic& finding : diagnostics.all()) out += finding.shown() + "\n";
  return out;
}

/// Every finding's text, a line each.
inline std::string texts(const Diagnostics& diagnostics) {
  std::string out;
  for (const Diagnostic& finding : diagnostics.all()) out += finding.text() + "\n";
  return out;
}

/// "" when `work` throws an Error with the code, or one that lists such a finding, which holds every one of `parts`.
template <class Work>
std::string unrefused(const Work& work, Code code, std::initializer_list<std::string_view> parts) {
  try {
    work();
  } catch (const FindingsError& error) {
    return unfound(error.findings(), code, parts);
  } catch (const Error& error) {
    if (error.code() == code) return unsaid(error.what(), parts);
    return std::string("the code is not ") + code.text() + ": " + shown(error);
  } catch (const std::exception& error) {
    return std::string("no Error: ") + error.what();
  }
  return std::string("nothing was refused, and ") + code.text() + " is expected";
}

/// "" when `text` holds none of `parts`; else the first that it holds, and the text.
inline std::string unwanted(std::string_view text, std::initializer_list<std::string_view> parts) {
  for (const std::string_view part : parts) {
    if (text.find(part) != std::string_view::npos)
      return "'" + std::string(part) + "' in '" + std::string(text.substr(0, kShown)) + "'";
  }
  return "";
}

/// What the Error says that `call` throws, "" when it throws none.
template <class Call>
[[nodiscard]] std::string error_of(Call&& call) {
  try {
    call();
  } catch (const Error& error) {
    return error.what();
  }
  return "";
}
/// The same, of an Error that is of `kind`.
template <class Call>
[[nodiscard]] std::string error_of(ErrorKind kind, Call&& call) {
  return error_of([&] {
    try {
      call();
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), kind) << error.what();
      throw;
    }
  });
}

}  // namespace semfield

/// EXPECT_HAS(text, "room.yaml:3", "rays"): the text holds each of the words.
#define EXPECT_HAS(text, ...) EXPECT_EQ(::semfield::unsaid(text, {__VA_ARGS__}), "")
#define EXPECT_LACKS(text, ...) EXPECT_EQ(::semfield::unwanted(text, {__VA_ARGS__}), "")

/// EXPECT_ERROR(read(path), "scene.pose.format", "poses.txt:3", "12"): the expression throws an Error with the code,
/// and its text holds each of the words behind.
#define EXPECT_ERROR(expression, code, ...) \
  EXPECT_EQ(::semfield::unrefused([&] { (void)(expression); }, code, {__VA_ARGS__}), "")

/// The same of one of the findings of a Diagnostics.
#define EXPECT_FINDING(diagnostics, code, ...) \
  EXPECT_EQ(::semfield::unfound((diagnostics).all(), code, {__VA_ARGS__}), "")
