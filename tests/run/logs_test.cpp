// metrics.jsonl and the TensorBoard file, each read back by code that shares nothing with its writer.
#include <cmath>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "run/metrics_log.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

class LogTest : public ::testing::Test {
 protected:
  std::string in(const std::string& name) const { return dir_ / name; }
  const TempDir dir_;
};

MetricsRow train_row(std::int64_t step) {
  MetricsRow row{.step = step, .train_s = 0.1 * static_cast<double>(step)};
  row.set("loss", 1.0 / 3);
  return row;
}

TEST_F(LogTest, RowsComeBackExactly) {
  {
    MetricsLog log = MetricsLog::create(in("metrics.jsonl"));
    log.append(train_row(7));
    MetricsRow row{.kind = "eval", .step = 7, .split = "test"};
    row.set("psnr", std::numeric_limits<double>::infinity());
    row.set("miou", std::nullopt);
    row.set("absrel", std::numeric_limits<double>::quiet_NaN());
    row.per_class_iou = {{"wall", 0.25}, {"a \"b\"\n", std::nullopt}};
    log.append(row);
  }
  const auto rows = read_metrics(in("metrics.jsonl"));
  ASSERT_EQ(rows.size(), 2u);
  EXPECT_EQ(rows[0].kind, "train");
  EXPECT_EQ(rows[0].get("loss"), 1.0 / 3);
  EXPECT_EQ(rows[0].train_s, 0.1 * 7);
  EXPECT_EQ(rows[1].get("psnr"), std::numeric_limits<double>::infinity());
  EXPECT_FALSE(rows[1].get("miou").has_value());
  EXPECT_TRUE(std::isnan(*rows[1].get("absrel")));
  EXPECT_EQ(rows[1].per_class_iou[1].first, "a \"b\"\n");
  // Any JSON reader can read every line.
  std::ifstream file(in("metrics.jsonl"));
  std::string line;
  ASSERT_TRUE(std::getline(file, line) && std::getline(file, line));
  const auto json = nlohmann::json::parse(line);
  EXPECT_EQ(json.at("psnr"), "inf");
  EXPECT_EQ(json.at("split"), "test");
  EXPECT_TRUE(json.at("miou").is_null());
  EXPECT_FALSE(std::getline(file, line));
}

TEST_F(LogTest, OnlyATornLastLineIsForgiven) {
  const std::string good = metrics_line(train_row(1)) + "\n" + metrics_line(train_row(2)) + "\n";
  for (std::size_t cut = 0; cut <= good.size(); ++cut) {
    const auto rows = parse_metrics(good.substr(0, cut), "m");
    EXPECT_EQ(rows.size(), cut == good.size() ? 2u : cut >= good.find('\n') + 1 ? 1u : 0u);
  }
  EXPECT_HAS(error_of(ErrorKind::data, [&] { (void)parse_metrics("{\"kind\":\"train\",\n" + good, "metrics.jsonl"); }),
             "metrics.jsonl:1: not a JSON object");
  EXPECT_THROW((void)parse_metrics("{\"kind\":\"train\"}\n", "m"), Error);
  EXPECT_THROW((void)parse_metrics("{\"step\":1,\"loss\":\"high\"}\n", "m"), Error);
}

TEST_F(LogTest, ResumeDropsLaterRowsAndTheTornLine) {
  {
    MetricsLog log = MetricsLog::create(in("m"));
    for (std::int64_t step : {10, 20, 30}) log.append(train_row(step));
  }
  std::ofstream(in("m"), std::ios::app) << "{\"kind\":\"tra";
  EXPECT_THROW((void)MetricsLog::create(in("m")), Error);
  {
    MetricsLog log = MetricsLog::resume(in("m"), 20);
    log.append(train_row(25));
  }
  const auto rows = read_metrics(in("m"));
  ASSERT_EQ(rows.size(), 3u);
  EXPECT_EQ(rows[1].step, 20);
  EXPECT_EQ(rows[2].step, 25);
}

// After a power cut lines behind the last sync may be anything; ahead of a row that is kept they may not.
TEST_F(LogTest, ResumeDropsWhatAPowerCutLeftAndRefusesOtherDamage) {
  const std::string good = metrics_line(train_row(10)) + "\n" + metrics_line(train_row(20)) + "\n";
  const std::string zeros(50, '\0'), later = metrics_line(train_row(30)) + "\n";
  std::ofstream(in("m")) << good << zeros << "\n" << later << zeros;
  {
    MetricsLog log = MetricsLog::resume(in("m"), 20);
    log.append(train_row(25));
    log.sync();
  }
  EXPECT_EQ(read_text_file(in("m")), good + metrics_line(train_row(25)) + "\n");
  std::ofstream(in("n")) << "half a row}\n" << good;
  EXPECT_HAS(error_of(ErrorKind::data, [&] { (void)MetricsLog::resume(in("n"), 20); }),
             in("n") + ":1: not a JSON object");
}

// --- an independent reader of records and of the few protobuf fields in them ---

std::uint32_t slow_crc32c(const std::string& bytes) {
  std::uint32_t crc = 0xFFFFFFFFu;
  for (unsigned char byte : bytes) {
    crc ^= byte;
    for (int bit = 0; bit < 8; ++bit) crc = (crc & 1) != 0 ? (crc >> 1) ^ 0x82F63B78u : crc >> 1;
  }
  return ~crc;
}

template <class T>
T fixed(const std::string& bytes, std::size_t at) {
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof(T));
  return value;
}

std::vector<std::string> records(const std::string& file) {
  std::vector<std::string> out;
  const auto masked = [](const std::string& bytes) {
    const std::uint32_t crc = slow_crc32c(bytes);
    return ((crc >> 15) | (crc << 17)) + 0xA282EAD8u;
  };
  std::size_t at = 0;
  while (at < file.size()) {
    const auto length = fixed<std::uint64_t>(file, at);
    EXPECT_EQ(fixed<std::uint32_t>(file, at + 8), masked(file.substr(at, 8)));
    out.push_back(file.substr(at + 12, length));
    EXPECT_EQ(fixed<std::uint32_t>(file, at + 12 + length), masked(out.back()));
    at += 16 + length;
  }
  return out;
}

// field number -> raw payload (varints as eight bytes)
std::map<int, std::string> fields(const std::string& message) {
  std::map<int, std::string> out;
  std::size_t at = 0;
  const auto varint = [&] {
    std::uint64_t value = 0;
    for (int shift = 0;; shift += 7) {
      const auto byte = static_cast<unsigned char>(message.at(at++));
      value |= static_cast<std::uint64_t>(byte & 0x7F) << shift;
      if (byte < 0x80) return value;
    }
  };
  while (at < message.size()) {
    const std::uint64_t key = varint();
    std::size_t size = 0;
    if ((key & 7) == 0) {
      const std::uint64_t value = varint();
      out[static_cast<int>(key >> 3)] = std::string(reinterpret_cast<const char*>(&value), 8);
      continue;
    }
    if ((key & 7) == 1) size = 8;
    if ((key & 7) == 5) size = 4;
    if ((key & 7) == 2) size = varint();
    out[static_cast<int>(key >> 3)] = message.substr(at, size);
    at += size;
  }
  return out;
}

TEST_F(LogTest, TensorboardFileReadsBack) {
  std::string path;
  {
    EventWriter writer(dir_.path(), 1000.25);
    path = writer.path();
    writer.scalar("eval/psnr", 20000, 31.5, 1001.5);
    writer.scalar("train/loss", 300, std::numeric_limits<double>::infinity(), 1002);
  }
  EXPECT_EQ(fs::path(path).filename().string().rfind("events.out.tfevents.0000001000.", 0), 0u) << path;
  const auto events = records(read_text_file(path));
  ASSERT_EQ(events.size(), 3u);
  EXPECT_EQ(fields(events[0])[3], "brain.Event:2");
  EXPECT_EQ(fixed<double>(fields(events[0])[1], 0), 1000.25);
  auto event = fields(events[1]);
  EXPECT_EQ(fixed<double>(event[1], 0), 1001.5);
  EXPECT_EQ(fixed<std::uint64_t>(event[2], 0), 20000u);
  auto value = fields(fields(event[5])[1]);
  EXPECT_EQ(value[1], "eval/psnr");
  EXPECT_EQ(fixed<float>(value[2], 0), 31.5f);
}

TEST(Tensorboard, ChecksumOfTheStandardCheckValue) {
  // CRC-32C("123456789") = E3069283, then rotated by 15 and shifted.
  EXPECT_EQ(slow_crc32c("123456789"), 0xE3069283u);
  EXPECT_EQ(masked_crc32c("123456789"), ((0xE3069283u >> 15) | (0xE3069283u << 17)) + 0xA282EAD8u);
}

}  // namespace
}  // namespace semfield
