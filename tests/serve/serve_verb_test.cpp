// The real program with a small room: clicks over HTTP, kills, signals, exports by its own verbs.
#include <fcntl.h>

#include <csignal>
#include <nlohmann/json.hpp>
#include <random>

#include "formats/zip_archive.h"
#include "labels/clicks/click_log.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "tests/program.h"
#include "tests/serve/served_page.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using namespace testing_http;
using namespace testing_program;
using Json = nlohmann::json;

Result run(const std::vector<std::string>& words, const TempDir& dir) {
  return testing_program::Process(program(), words, dir.path()).wait();
}

// A `semfield serve` that has printed its address; the test ends otherwise.
class Served {
 public:
  Served(const std::string& what, const TempDir& dir, const std::vector<std::string>& more = {})
      : process_(program(), words(what, more), dir.path()) {
    const std::string said = "serve: open http://127.0.0.1:", out = dir / "stdout";
    for (int i = 0; i < 3000 && line_.find('\n') == std::string::npos; ++i) {
      if (process_.wait_for(0.01)) break;
      line_ = read_text_file(out);
    }
    if (!line_.starts_with(said)) throw std::runtime_error("it does not serve: " + process_.err_so_far());
    port_ = std::atoi(line_.c_str() + said.size());
    const std::size_t slash = line_.find('/', said.size());
    folder_ = line_.substr(slash, line_.find(' ', slash) - slash);
  }

  int port() const { return port_; }
  const std::string& folder() const { return folder_; }
  testing_program::Process& process() { return process_; }
  Result ended_by(int signal) {
    process_.send(signal);
    return process_.wait();
  }

  std::string text(const std::string& method, const std::string& name, const std::string& body = "") const {
    return method + " " + folder_ + name + " HTTP/1.1\r\nHost: 127.0.0.1:" + std::to_string(port_) +
           "\r\nContent-Length: " + std::to_string(body.size()) + "\r\n\r\n" + body;
  }
  Answer ask(const std::string& method, const std::string& name, const std::string& body = "") const {
    Connection c(port_);
    c.send(text(method, name, body));
    return c.receive(120);
  }
  Json state(const std::string& after = "0") const { return Json::parse(ask("GET", "state?after=" + after).body); }
  std::string click(const std::string& id) const {
    const Json view = state()["views"][0];
    return Json{
        {"id", id},           {"type", "click"}, {"frame", view["frame"]}, {"size", {view["width"], view["height"]}},
        {"points", {{3, 4}}}, {"radius", 2},     {"class", "chair"}}
        .dump();
  }

 private:
  static std::vector<std::string> words(const std::string& what, const std::vector<std::string>& more) {
    std::vector<std::string> all{"serve", what};
    all.insert(all.end(), more.begin(), more.end());
    return all;
  }
  testing_program::Process process_;
  std::string line_, folder_;
  int port_ = 0;
};

constexpr const char* kChair = R"({"id":"c","type":"class","name":"chair"})";

TEST(ServeVerb, ClicksOutliveKillsAndTheRunGoesOn) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 200, 1), room = dir / "room";
  std::string address;
  {
    Served served(config, dir, {"--out", room});
    EXPECT_EQ(served.ask("POST", "event", kChair).status, 200);
    EXPECT_EQ(Json::parse(served.ask("POST", "event", served.click("k")).body)["applied"], true);
    address = served.folder();
    (void)served.ended_by(SIGKILL);
  }
  {
    Served served(config, dir, {"--out", room});
    EXPECT_HAS(served.process().err_so_far(),
               "continuing with " + room + ", which is there already, by the settings in its run.yaml");
    EXPECT_EQ(served.folder(), address);  // a page that is open goes on
    const Json s = served.state();
    EXPECT_EQ(s["events"], 2);
    EXPECT_EQ(s["marks"].size(), 1u);
    EXPECT_EQ(Json::parse(served.ask("POST", "event", served.click("k")).body)["applied"], false);
    EXPECT_ENDED(served.ended_by(SIGINT), 130, " labels, all saved\nnext        semfield serve " + room);
  }
  Served served(room, dir);
  EXPECT_EQ(served.state()["events"], 2);
  EXPECT_EQ(served.ended_by(SIGTERM).code, 143);
}

// Kills at any moment between a click and its acknowledgement; SEMFIELD_TORTURE_KILLS sets how many.
TEST(ServeVerb, RandomKillsLoseNoAnsweredClick) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 200, 1), room = dir / "room";
  const char* wanted = std::getenv("SEMFIELD_TORTURE_KILLS");
  const int kills = wanted != nullptr ? std::atoi(wanted) : 8;
  std::mt19937 random(11);
  std::set<std::string> answered;
  for (int kill = 0; kill < kills; ++kill) {
    Served served(config, dir, {"--out", room});
    if (kill == 0) {
      ASSERT_EQ(served.ask("POST", "event", kChair).status, 200);
    }
    const Json s = served.state();
    EXPECT_EQ(s["failure"], "");
    std::set<std::string> there;
    for (const Json& mark : s["marks"]) there.insert(mark["id"]);
    for (const std::string& id : answered) EXPECT_TRUE(there.contains(id)) << id << " is lost after kill " << kill;
    const std::string form = served.click("ID");
    const auto last = std::chrono::steady_clock::now() + std::chrono::microseconds(random() % 60000);
    std::thread killer([&] {
      std::this_thread::sleep_until(last);
      served.process().send(SIGKILL);
    });
    Connection c(served.port());
    for (int n = 0;; ++n) {
      const std::string id = "k" + std::to_string(kill) + "-" + std::to_string(n);
      std::string event = form;
      event.replace(event.find("ID"), 2, id);
      if (!c.send(served.text("POST", "event", event)) || c.receive(10).status != 200) break;
      answered.insert(id);
    }
    killer.join();
    served.process().wait();
  }
  EXPECT_GT(answered.size(), 10u);
}

TEST(ServeVerb, ExportsAreThoseOfTheVerbs) {
  const TempDir dir;
  Served served(write_packed_config(dir, 50, 1), dir, {"--out", dir / "room"});
  ASSERT_EQ(served.ask("POST", "event", kChair).status, 200);
  ASSERT_EQ(served.ask("POST", "event", served.click("k")).status, 200);
  const Json before = served.state();
  std::size_t views = 0;  // those that train
  for (const Json& view : before["views"]) views += view["held_out"] == false ? 1 : 0;
  for (const char* what : {"labels", "coco", "mesh"}) {
    const Answer begun = served.ask("POST", "export", Json{{"what", what}}.dump());
    ASSERT_EQ(begun.status, 200) << begun.body;
    Json s = served.state();
    const auto end = std::chrono::steady_clock::now() + std::chrono::minutes(4);
    const auto is_open = [&] {
      return s["exports"].back()["state"] == "waiting" || s["exports"].back()["state"] == "running";
    };
    while (is_open() && std::chrono::steady_clock::now() < end) s = served.state(s["revision"].dump());
    ASSERT_EQ(s["exports"].back()["state"], "done") << s["exports"].dump(1);
  }
  const std::string zip = served.ask("GET", "export/labels-1/0").body;
  EXPECT_EQ(zip_entries(zip).size(), views + 1);  // and the classes
  EXPECT_EQ(Json::parse(served.ask("GET", "export/coco-1/0").body)["images"].size(), views);
  EXPECT_EQ(served.ask("GET", "export/mesh-1/0").body.substr(0, 4), "ply\n");
  EXPECT_EQ(served.ask("GET", "export/mesh-1/1").body.substr(0, 4), "glTF");
  EXPECT_EQ(served.ask("GET", "export/mesh-1/2").body.substr(0, 4), "ply\n");
  EXPECT_EQ(served.ask("GET", "export/mesh-1/3").body.substr(0, 4), "glTF");
}

TEST(ServeVerb, TheNextPortIsTakenUnlessOneIsNamed) {
  const TempDir dir, other;
  const std::string config = write_packed_config(dir, 50, 1);
  Served first(config, dir, {"--out", dir / "room"});
  const Result named = run({"serve", config, "--out", other / "room", "--port", std::to_string(first.port())}, other);
  EXPECT_EQ(named.code, 69);
  EXPECT_EQ(named.err, "semfield: port " + std::to_string(first.port()) +
                           " of 127.0.0.1 is taken by another program; end that program, name another port, or leave "
                           "--port out [serve.port.taken]\n");
  EXPECT_FALSE(std::filesystem::exists(other / "room"));
  Served second(config, other, {"--out", other / "room"});
  EXPECT_NE(second.port(), first.port());
}

// As on a full disk: a file stands where checkpoints are written.
TEST(ServeVerb, WhatCannotBeWrittenIsToldAndEndsWithItsOwnExitCode) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 100000, 0.05), room = dir / "room";
  Served served(config, dir, {"--out", room});
  EXPECT_EQ(served.ask("POST", "event", kChair).status, 200);
  for (int turn = 0; turn < 600 && !std::filesystem::exists(room + "/checkpoints/latest"); ++turn)
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
  // One exchange, because the program goes on writing into the folder.
  write_file_atomic(room + "/file", "");
  ASSERT_EQ(renameat2(AT_FDCWD, (room + "/file").c_str(), AT_FDCWD, (room + "/checkpoints").c_str(), RENAME_EXCHANGE),
            0);
  Json s = served.state();
  const auto end = std::chrono::steady_clock::now() + std::chrono::minutes(2);
  while (s["trouble"] == "" && std::chrono::steady_clock::now() < end) s = served.state(s["revision"].dump());
  EXPECT_HAS(s["trouble"].get<std::string>(), "checkpoints");
  EXPECT_EQ(s["failure"], "");
  EXPECT_EQ(Json::parse(served.ask("POST", "event", served.click("k")).body)["applied"], true);
  const Result ended = served.ended_by(SIGTERM);
  EXPECT_EQ(ended.code, static_cast<int>(ErrorKind::io)) << ended.err;
  EXPECT_HAS(ended.err, "every label is stored");
}

// A disk of 6 MB that somebody else fills for a moment while checkpoints are written.
TEST(ServeVerb, AFullDiskEndsNothingAndNoRowIsLost) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 1000000, 0.05), disk = dir / "disk", script = dir / "script";
  std::filesystem::create_directory(disk);
  const std::string probe = "unshare -rm mount -t tmpfs tmpfs " + shell_word(disk) + " 2>/dev/null";
  if (std::system(probe.c_str()) != 0)
    GTEST_SKIP() << "this system lets nobody mount a tmpfs in a namespace of its own";
  const std::string run_dir = shell_word(disk + "/run"), latest = shell_word(disk + "/run/checkpoints/latest"),
                    other = shell_word(disk + "/other"), out = shell_word(dir.path());
  write_file_atomic(script, "mount -t tmpfs -o size=6m tmpfs " + shell_word(disk) + " || exit 99\n" +
                                shell_word(program()) + " serve " + shell_word(config) + " --out " + run_dir + " >" +
                                out + "/out 2>" + out + "/err &\npid=$!\n" +  //
                                "turn=0; until [ -e " + latest +
                                " ] || [ $turn = 600 ]; do sleep 0.1; turn=$((turn + 1)); done\n"
                                "dd if=/dev/zero of=" +
                                other +
                                " bs=1k 2>/dev/null\n"
                                "sleep 2; before=$(cat " +
                                latest + "); rm " + other +
                                "\n"
                                "turn=0; until [ \"$(cat " +
                                latest +
                                ")\" != \"$before\" ] || [ $turn = 600 ]; do sleep 0.1; turn=$((turn + 1)); done\n"
                                "kill -TERM $pid; wait $pid; echo $? >" +
                                out + "/code; echo $turn >" + out + "/turn\ncp -r " + run_dir + " " + out + "/copy\n");
  ASSERT_EQ(std::system(("unshare -rm sh " + shell_word(script)).c_str()), 0);
  EXPECT_EQ(read_text_file(dir / "code"), "143\n") << read_text_file(dir / "err");
  EXPECT_NE(read_text_file(dir / "turn"), "600\n") << "no checkpoint is written after the disk has room again";
  std::int64_t last = 0;
  for (const MetricsRow& row : read_metrics(dir / "copy/metrics.jsonl")) {
    EXPECT_EQ(row.step, last + 5) << "a row is lost or torn";
    last = row.step;
  }
  Diagnostics diagnostics;
  const auto kept = CheckpointStore::read(dir / "copy/checkpoints").find_latest(diagnostics);
  ASSERT_TRUE(kept.has_value());
  EXPECT_TRUE(diagnostics.all().empty());
  EXPECT_GE(kept->step, last);
}

// A run begun with another's run.yaml must not click into that run's file.
TEST(ServeVerb, AnotherRunsClicksAreNotAddedTo) {
  const TempDir dir, other;
  const std::string config = write_packed_config(dir, 50, 1), room = dir / "room";
  {
    Served served(config, dir, {"--out", room});
    EXPECT_EQ(served.ask("POST", "event", kChair).status, 200);
    EXPECT_EQ(served.ended_by(SIGTERM).code, 143);
  }
  const std::string before = read_text_file(room + "/clicks.jsonl");
  EXPECT_ENDED(run({"serve", room + "/run.yaml", "--out", other / "room"}, other), 73,
               "the clicks in '" + room + "/clicks.jsonl' are those of another run");
  EXPECT_EQ(read_text_file(room + "/clicks.jsonl"), before);
}

TEST(ServeVerb, ARunOfTrainIsNotTakenForOneOfItsOwn) {
  const TempDir dir;
  const std::string config = write_packed_config(dir, 3, 1), room = dir / "room";
  ASSERT_EQ(run({"train", config, "--out", room, "-q"}, dir).code, 0);
  for (const std::vector<std::string>& words :
       {std::vector<std::string>{"serve", config, "--out", room}, {"serve", room}}) {
    EXPECT_ENDED(run(words, dir), 73, room + ": it holds a run that was not begun by `semfield serve`");
  }
  EXPECT_FALSE(std::filesystem::exists(room + "/clicks.jsonl"));
}

TEST(ServeVerb, ARunThatIsServedAlreadyIsLeftAlone) {
  const TempDir dir, other;
  Served first(write_packed_config(dir, 50, 1), dir, {"--out", dir / "room"});
  const Result second = run({"serve", dir / "room"}, other);
  EXPECT_NE(second.code, 0);
  EXPECT_HAS(second.err, dir / "room");
  EXPECT_EQ(first.ask("POST", "event", kChair).status, 200);
}

}  // namespace
}  // namespace semfield
