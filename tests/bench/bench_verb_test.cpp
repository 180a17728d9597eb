// `semfield bench step` on narrow networks: its words, its last line, and that steps allocate nothing.
#include <gtest/gtest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <array>
#include <cstdio>
#include <fstream>
#include <memory>
#include <nlohmann/json.hpp>
#include <regex>

#include "core/text.h"

namespace semfield {
namespace {

using nlohmann::json;

struct Result {
  int code = -1;
  std::string out;
};

Result run(const std::string& words) {
  Result result;
  FILE* const pipe = popen((shell_word(SEMFIELD_PROGRAM) + " -q " + words + " 2>&1").c_str(), "r");
  std::array<char, 4096> buffer{};
  while (fgets(buffer.data(), static_cast<int>(buffer.size()), pipe) != nullptr) result.out += buffer.data();
  result.code = WEXITSTATUS(pclose(pipe));
  return result;
}

const char* const kTiny = "bench step --size tiny --repeats 1 ";

std::string last_line(const std::string& text) {
  const std::size_t end = text.find_last_not_of('\n');
  const std::size_t begin = text.rfind('\n', end);
  return text.substr(begin + 1, end - begin);
}

TEST(BenchVerb, LastLineHasEveryGoal) {
  const Result r = run(kTiny);
  ASSERT_EQ(r.code, 0) << r.out;
  const std::string number = R"(([0-9]+\.[0-9]{1,2}))";
  EXPECT_TRUE(std::regex_match(last_line(r.out), std::regex("bench: P1=n/a P2=n/a P2c=(" + number + "|n/a) P3=n/a P4=" +
                                                            number + " P7=" + number + " P8=" + number + " threads2=(" +
                                                            number + "|n/a) P15=(" + number + "|n/a) isa=[a-z0-9_]+")))
      << last_line(r.out);
}

TEST(BenchVerb, StepsAllocateNothingAfterTheFirst) {
  const Result r = run(std::string("--json ") + kTiny);
  ASSERT_EQ(r.code, 0) << r.out;
  const json out = json::parse(r.out);
  int rows = 0;
  for (const char* group : {"steps", "classes", "scaling"}) {
    for (const json& row : out[group]) {
      ++rows;
      EXPECT_EQ(row["allocated_bytes"], 0) << row.dump();
      EXPECT_GT(row["seconds"]["median"], 0) << row.dump();
      EXPECT_GT(row["flop"], 0) << row.dump();
    }
  }
  EXPECT_GE(rows, 13);  // three networks, five numbers of classes for two of them
  EXPECT_GT(out["peak_fp32_flops"][0], 0);
  EXPECT_NEAR(out["goals"]["P4"].get<double>(), out["steps"][0]["peak_share"].get<double>(), 1e-12);
}

TEST(BenchVerb, WithoutAPeerItSaysWhy) {
  const Result r = run(std::string(kTiny) + "--peers --python /no/such/python");
  EXPECT_EQ(r.code, 0) << r.out;
  EXPECT_NE(r.out.find("no Python with torch (asked: /no/such/python)"), std::string::npos) << r.out;
  EXPECT_NE(last_line(r.out).find("P1=n/a P2=n/a P2c="), std::string::npos) << r.out;
}

// An interpreter that answers as the peer's script does, always with the same time.
TEST(BenchVerb, RatiosAreOfRatesBesideThePeer) {
  const std::string fake = testing::TempDir() + "fake_python_" + std::to_string(::getpid());
  std::ofstream(fake) << "#!/bin/sh\n[ \"$1\" = -c ] && exit 0\n"
                         "echo '{\"torch\": \"0\", \"threads\": 2, \"blas\": \"openblas\"}'\n"
                         "while read -r line; do\n"
                         "  case $line in *hash*) echo '{\"seconds\": 2.0}';; *) echo '{\"seconds\": 3.0}';; esac\n"
                         "done\n";
  chmod(fake.c_str(), 0755);
  const Result r = run(std::string("--json ") + kTiny + "--peers --python " + shell_word(fake));
  ASSERT_EQ(r.code, 0) << r.out;
  const json out = json::parse(r.out);
  ASSERT_GE(out["peers"].size(), 4u) << r.out;
  double hash_rate = 0, paper_rate = 0;
  for (const json& row : out["steps"]) {
    if (row["net"] == "hash T=2^15" && row["precision"] == "fp32") hash_rate = row["samples_per_s"];
    if (row["net"] == "paper" && row["precision"] == "fp32") paper_rate = row["samples_per_s"];
  }
  const double rays = out["steps"][0]["rays"];
  EXPECT_NEAR(out["goals"]["P1"].get<double>(), paper_rate / (rays * 256 / 3.0), 1e-6);
  EXPECT_NEAR(out["goals"]["P3"].get<double>(), hash_rate / (rays * 30 / 2.0), 1e-6);
}

TEST(BenchVerb, WrongWordsAreRefused) {
  EXPECT_EQ(run("bench step --size huge").code, 2);
  EXPECT_EQ(run("bench step --repeats 0").code, 2);
  EXPECT_EQ(run(std::string(kTiny) + "--set runtime.thread=1").code, 78);
  EXPECT_EQ(run("bench").code, 2);
}

}  // namespace
}  // namespace semfield
