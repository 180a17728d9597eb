// Every address of the page over a real socket, against a source that is no training.

#include <sys/stat.h>
#include <turbojpeg.h>

#include <fstream>
#include <future>
#include <nlohmann/json.hpp>
#include <set>

#include "app/serve/page_pictures.h"
#include "app/serve/page_requests.h"
#include "formats/image_io.h"
#include "formats/zip_archive.h"
#include "tests/says.h"
#include "tests/serve/served_page.h"

namespace semfield::app {
namespace {

using Json = nlohmann::json;
using namespace testing_http;

// The parts of a picture's answer: facts, photograph, labels, entropy.
std::vector<std::string> parts_of(const Answer& answer) {
  std::vector<std::string> parts;
  for (std::size_t at = 0; at < answer.body.size(); at += 4 + parts.back().size()) {
    std::uint32_t size = 0;
    for (std::size_t i = 4; i-- > 0;) size = size << 8 | static_cast<unsigned char>(answer.body.at(at + i));
    parts.push_back(answer.body.substr(at + 4, size));
  }
  return parts;
}

PngImage png(const std::string& bytes) { return decode_png(std::as_bytes(std::span(bytes))); }

TEST_F(ServedPage, FilesOfTheListAloneAreServedWithTheirTypes) {
  const Answer index = get("");
  EXPECT_EQ(index.status, 200);
  EXPECT_EQ(index.body, "<html></html>");
  EXPECT_EQ(index.header("content-type"), "text/html; charset=utf-8");
  EXPECT_EQ(index.header("referrer-policy"), "no-referrer");
  EXPECT_EQ(index.header("cache-control"), "no-store");
  EXPECT_EQ(index.header("set-cookie"), "");
  EXPECT_EQ(index.header("access-control-allow-origin"), "");
  EXPECT_EQ(index.header("content-security-policy").find("default-src 'self'; img-src 'self' blob: data:;"), 0u);
  EXPECT_EQ(get("app.js").header("content-type"), "text/javascript; charset=utf-8");
  for (const char* other : {"style.css", "../app.js", "..%2fapp.js", "%61pp.js", "./app.js", "app.js/", "/etc/passwd",
                            "../../../../../../etc/passwd", "export/../../x/0", "index.html%00.js"})
    EXPECT_EQ(get(other).status, 404) << other;
}

TEST_F(ServedPage, TheSecretFolderWithoutItsSlashLeadsIntoIt) {
  const Answer onward = ask("GET /" + token() + " HTTP/1.1\r\nHost: " + host() + "\r\n\r\n");
  EXPECT_EQ(onward.status, 308);
  EXPECT_EQ(onward.header("location"), "/" + token() + "/");
}

TEST_F(ServedPage, StateHasTheKeysOfTheContract) {
  const Answer answer = get("state?after=0");
  ASSERT_EQ(answer.status, 200);
  EXPECT_EQ(answer.header("content-type"), "application/json");
  EXPECT_EQ(answer.header("cache-control"), "no-store");
  const Json s = Json::parse(answer.body);
  EXPECT_EQ(s["revision"], 5);
  EXPECT_EQ(s["run"]["id"], "run-1");
  EXPECT_EQ(s["run"]["name"], "room");
  EXPECT_EQ(s["room"], (Json{{"named", 2}, {"most", 8}}));
  EXPECT_EQ(s["classes"][1]["name"], "chair");
  EXPECT_EQ(s["classes"][1]["color"], (Json{200, 30, 30}));
  EXPECT_EQ(s["views"][1], (Json{{"index", 1},
                                 {"frame", "b"},
                                 {"width", 6},
                                 {"height", 4},
                                 {"clicks", 1},
                                 {"entropy", 0.5},
                                 {"ready", true},
                                 {"photo", "b1"},
                                 {"held_out", false}}));
  EXPECT_EQ(s["proposal"]["at"], (Json{2.5, 3.5}));
  EXPECT_EQ(s["marks"][0]["view"], 1);  // of frame 7
  EXPECT_EQ(s["marks"][0]["points"], (Json{{1.5, 2.5}}));
  EXPECT_EQ(s["trouble"], "");
  EXPECT_EQ(s["failure"], "");
}

// Whoever asks with the revision of an earlier answer gets what has changed since, and the same with any other's
// answers.
TEST_F(ServedPage, AnAnswerHasWhatChangedSinceTheOneBefore) {
  const Json whole = Json::parse(get("state?after=0").body);
  EXPECT_EQ(whole["marks_kept"], 0);
  source_.change([](LabelState& s) { s.views[1].entropy = 0.3; });
  EXPECT_EQ(Json::parse(get("state?after=5").body),
            (Json{{"revision", 6}, {"views", {{{"index", 1}, {"entropy", 0.3}}}}}));
  source_.change([](LabelState& s) {
    s.views[1].entropy = 0.30004;  // nobody sees that
    s.marks.push_back({"m2", 7, {{0.5, 0.5}}, 2, 1});
  });
  const Json third = Json::parse(get("state?after=6").body);
  EXPECT_EQ(third.size(), 3u) << third;
  EXPECT_EQ(third["marks_kept"], 1);
  EXPECT_EQ(third["marks"].size(), 1u);
  EXPECT_EQ(third["marks"][0]["id"], "m2");
  source_.change([](LabelState& s) { s.marks.pop_back(); });
  EXPECT_EQ(Json::parse(get("state?after=7").body),
            (Json{{"revision", 8}, {"marks", Json::array()}, {"marks_kept", 1}}));
  source_.change([](LabelState& s) {
    s.marks = {{"m3", 7, {{0.5, 0.5}}, 2, 1}};
    s.classes[0].name = "floor";
  });
  const Json last = Json::parse(get("state?after=5").body);
  EXPECT_EQ(last["marks_kept"], 0);
  EXPECT_EQ(last["marks"][0]["id"], "m3");
  EXPECT_EQ(last["classes"].size(), 2u);
  EXPECT_EQ(last["views"], (Json{{{"index", 1}, {"entropy", 0.3}}}));
  EXPECT_FALSE(last.contains("run"));
  EXPECT_EQ(Json::parse(get("state?after=0").body)["views"][0], whole["views"][0]);
}

TEST_F(ServedPage, NewsAreWaitedForAndComeAtOnce) {
  PageOptions o = options();
  o.longest_poll_ms = 600'000;
  start(o);
  std::future<Answer> waiting = std::async(std::launch::async, [&] { return get("state?after=5"); });
  EXPECT_EQ(waiting.wait_for(std::chrono::milliseconds(300)), std::future_status::timeout);
  source_.change([](LabelState& s) { s.phase = "changed"; });
  const Answer answer = waiting.get();  // without it, none within the client's 30 s
  EXPECT_EQ(Json::parse(answer.body)["run"]["phase"], "changed");
  EXPECT_EQ(Json::parse(answer.body)["revision"], 6);
  start();
  // Without news the old state comes when the wait is over; a number from an earlier server does not wait.
  EXPECT_EQ(Json::parse(get("state?after=6").body)["revision"], 6);
  EXPECT_EQ(Json::parse(get("state?after=1000").body)["marks_kept"], 0);
}

TEST_F(ServedPage, NobodyWaitsForNewsOnceTheSessionEnds) {
  PageOptions o = options();
  o.longest_poll_ms = 600'000;
  start(o);
  server_->end_waiting();
  EXPECT_EQ(Json::parse(get("state?after=5").body)["revision"], 5);
}

TEST_F(ServedPage, APageOfAnEarlierServerGetsEverythingAnew) {
  PageOptions o = options();
  o.first_revision = 1000;
  start(o);
  const Json s = Json::parse(get("state?after=900").body);
  EXPECT_EQ(s["revision"], 1005);
  EXPECT_EQ(s["marks"].size(), 1u);
  source_.change([](LabelState& now) { now.phase = "changed"; });
  const Json news = Json::parse(get("state?after=1005").body);
  EXPECT_TRUE(news.contains("run"));
  EXPECT_FALSE(news.contains("marks"));
}

TEST_F(ServedPage, AnEventIsAppliedOnceAndItsTimeIsTheServers) {
  const Answer first = post("event", click("a-1"));
  ASSERT_EQ(first.status, 200);
  EXPECT_EQ(Json::parse(first.body), (Json{{"applied", true}, {"revision", 6}}));
  EXPECT_EQ(Json::parse(post("event", click("a-1")).body)["applied"], false);
  ASSERT_EQ(source_.events().size(), 1u);
  EXPECT_GT(source_.events()[0].unix_ms, 1'700'000'000'000);
  EXPECT_EQ(source_.events()[0].class_name, "chair");
}

TEST_F(ServedPage, RefusedEventsSayWhyAndWhatToDo) {
  const Answer unknown = post("event", click("a-1", "nobody"));
  EXPECT_EQ(unknown.status, 400);
  EXPECT_EQ(Json::parse(unknown.body),
            (Json{{"error", "no class 'nobody'"}, {"code", "labels.class.unknown"}, {"remedy", "add it first"}}));
  EXPECT_EQ(post("event", click("a-1", "full disk")).status, 503);
  EXPECT_EQ(post("event", click("a-1", "broken")).status, 500);
  for (const char* to : {"event", "picture", "thing", "export"})  // other bytes: fuzz_page and fuzz_http of tests/fuzz
    for (const char* bytes : {"{", "", "\xFF\x00", "{}!"}) EXPECT_EQ(post(to, bytes).status, 400) << to << bytes;
  EXPECT_TRUE(source_.requests.empty());
  EXPECT_EQ(source_.events().size(), 0u);
}

TEST_F(ServedPage, APictureHasItsFactsAndEveryMapThatWasAskedFor) {
  const Answer answer = post("picture", R"({"client":"c","view":1,"color":true,"entropy":true})");
  ASSERT_EQ(answer.status, 200);
  EXPECT_EQ(answer.header("content-type"), "application/octet-stream");
  const std::vector<std::string> parts = parts_of(answer);
  ASSERT_EQ(parts.size(), 4u);
  const Json facts = Json::parse(parts[0]);
  EXPECT_EQ(facts["width"], 4);
  EXPECT_EQ(facts["overlay_revision"], 9);
  EXPECT_EQ(facts["stale"], false);
  EXPECT_EQ(parts[1].substr(0, 2), "\xFF\xD8");
  const PngImage labels = png(parts[2]);
  EXPECT_TRUE(labels.palette);
  EXPECT_EQ(labels.bytes, (std::vector<std::uint8_t>{0, 1, 2, 2, 0, 1, 2, 2, 0, 1, 2, 6}));
  EXPECT_EQ(labels.palette_alpha, std::vector<std::uint8_t>{0});
  ASSERT_GE(labels.palette_rgb.size(), 21u);  // none, six classes; the last is not named yet
  EXPECT_EQ(std::vector<std::uint8_t>(labels.palette_rgb.begin() + 6, labels.palette_rgb.begin() + 9),
            (std::vector<std::uint8_t>{200, 30, 30}));
  EXPECT_EQ(png(parts[3]).bytes[11], 255);
}

TEST_F(ServedPage, MapsThatWereNotAskedForHaveNoBytes) {
  const std::vector<std::string> parts = parts_of(post("picture", R"({"client":"c","view":0})"));
  ASSERT_EQ(parts.size(), 4u);
  EXPECT_EQ(parts[1], "");
  EXPECT_NE(parts[2], "");
  EXPECT_EQ(parts[3], "");
}

TEST_F(ServedPage, AThingIsItsFactsOutlinesAndAMaskOfThePhotographsSize) {
  const Answer answer =
      post("thing", R"({"client":"c","view":0,"also":[[0.5,1.25],[3,2]],"not":[[2.5,2.5]],"level":2})");
  ASSERT_EQ(answer.status, 200) << answer.body;
  ASSERT_EQ(source_.requests.size(), 1u);
  const ThingRequest& asked = source_.requests[0].thing.value();
  EXPECT_EQ(asked.also, (std::vector<PixelPoint>{{0.5, 1.25}, {3, 2}}));
  EXPECT_EQ(asked.without, (std::vector<PixelPoint>{{2.5, 2.5}}));
  const std::vector<std::string> parts = parts_of(answer);
  ASSERT_EQ(parts.size(), 2u);
  EXPECT_EQ(Json::parse(parts[0]), (Json{{"stale", false},
                                         {"level", 2},
                                         {"least", -2},
                                         {"most", 3},
                                         {"share", 0.5},
                                         {"class_guess", 1},
                                         {"width", 4},
                                         {"height", 3},
                                         {"outlines", {{{2.0, 0.0}, {2.0, 3.0}, {0.0, 3.0}, {0.0, 0.0}}}}}));
  EXPECT_EQ(png(parts[1]).bytes, (std::vector<std::uint8_t>{255, 255, 0, 0, 255, 255, 0, 0, 255, 255, 0, 0}));
  // The photograph of the other view is larger, and its outlines are in pixels of the view all the same.
  const std::vector<std::string> large = parts_of(post("thing", R"({"client":"c","view":1,"also":[[1,1]]})"));
  const Json facts = Json::parse(large.at(0));
  EXPECT_EQ(facts["width"], 12);
  EXPECT_EQ(facts["height"], 8);
  EXPECT_EQ(facts["outlines"], (Json{{{3.0, 0.0}, {3.0, 4.0}, {0.0, 4.0}, {0.0, 0.0}}}));
  EXPECT_EQ(png(large.at(1)).bytes.size(), 96u);
}

TEST_F(ServedPage, WrongRequestsForThingsAreRefused) {
  const std::vector<std::pair<std::string, std::string>> rows{
      {R"({"client":"c","view":0})", "key 'also' is missing"},
      {R"({"client":"c","view":0,"also":[]})", "'also' names no place"},
      {R"({"client":"c","view":0,"also":[[1,2,3]]})", "'also': expected at most 4096 points"},
      {R"({"client":"c","view":0,"also":[[1,2e9]]})", "'also': expected at most 4096 points"},
      {R"({"client":"c","view":0,"also":[[1,2]],"not":[1]})", "'not': expected at most 4096 points"},
      {R"({"client":"c","view":0,"also":[[1,2]],"level":1.5})", "'level': expected"},
      {R"({"client":"c","view":0,"also":[[1,2]],"labels":true})", "labels"},
      {R"({"client":"c","view":2,"also":[[1,2]]})", "the scene has 2 views"}};
  for (const auto& [json, words] : rows) {
    const Answer answer = post("thing", json);
    EXPECT_EQ(answer.status, 400) << json;
    EXPECT_HAS(answer.body, words) << json;
  }
  EXPECT_TRUE(source_.requests.empty());
}

TEST_F(ServedPage, PhotographsMayBeKeptAndShrink) {
  const Answer whole = get("photo?view=1");
  ASSERT_EQ(whole.status, 200);
  EXPECT_EQ(whole.header("content-type"), "image/jpeg");
  // For ever under the name of what it shows alone: the run may be opened again with another image in its place.
  EXPECT_HAS(get("photo?view=1&photo=b1").header("cache-control"), "immutable");
  for (const char* unnamed : {"photo?view=1", "photo?view=1&photo=a1", "photo?view=1&photo="})
    EXPECT_EQ(get(unnamed).header("cache-control"), "no-store") << unnamed;
  EXPECT_EQ(get("photo?view=1&most_px=3").status, 200);
  EXPECT_NE(get("photo?view=1&most_px=3").body, whole.body);
  EXPECT_EQ(get("photo?view=1&most_px=9999").body, whole.body);
  EXPECT_EQ(source_.photos, (std::vector<std::int32_t>{0, 0, 0, 0, 0, 3, 3, 9999}));
  for (const char* wrong : {"photo", "photo?view=2", "photo?view=-1", "photo?view=x", "photo?view=1&most_px=65537",
                            "photo?view=99999999999999999999"})
    EXPECT_EQ(get(wrong).status, 400) << wrong;
}

TEST_F(ServedPage, APictureTellsTheClicksOfOtherViews) {
  const Json head = Json::parse(parts_of(post("picture", R"({"client":"c","view":0})")).at(0));
  EXPECT_EQ(head["marks"], (Json::array({{{"id", "m1"}, {"points", {{0.5, 1.5}, {2.5, 1.5}}}}})));
}

TEST_F(ServedPage, AViewThatIsNotThereIsNamed) {
  const Answer answer = post("picture", R"({"client":"c","view":2})");
  EXPECT_EQ(answer.status, 400);
  EXPECT_EQ(Json::parse(answer.body)["error"], "view 2: the scene has 2 views");
  EXPECT_TRUE(source_.requests.empty());
}

TEST_F(ServedPage, AnotherMethodIsRefusedWithTheRightOne) {
  EXPECT_EQ(get("event").header("allow"), "POST");
  EXPECT_EQ(post("state", "").header("allow"), "GET");
  EXPECT_EQ(ask(text("OPTIONS", "event", "", "Access-Control-Request-Method: POST\r\n")).status, 405);
  EXPECT_EQ(ask(text("DELETE", "")).status, 405);
}

// Requests for pictures and exports: what is accepted, what the refusals say, and what exports leave.

using testing_http::Answer;

std::string refusal(const std::string& json) {
  return error_of(ErrorKind::data, [&] { (void)parse_picture_request(json); });
}

TEST(PictureRequestText, WrongOnesAreNamed) {
  const std::vector<std::pair<std::string, std::string>> rows{
      {"[]", "expected a map, got a list of 0"},
      {"{", "not valid JSON"},
      {"{}", "key 'client' is missing"},
      {R"({"client":"c"})", "key 'view' is missing"},
      {R"({"client":"a b","view":1})", "'client': expected"},
      {R"({"client":"c","view":-1})", "'view': expected a whole number from 0"},
      {R"({"client":"c","view":1.5})", "'view': expected"},
      {R"({"client":"c","view":1,"view":2})", "key \"view\" is given twice"},
      {R"({"client":"c","veiw":1})", "did you mean 'view'?"},
      {R"({"client":"c","view":1,"color":1})", "'color': expected true or false"},
      {R"({"client":"c","view":1,"labels":false})", "no map is asked for"}};
  for (const auto& [json, words] : rows) EXPECT_HAS(refusal(json), words) << json << "\n  " << refusal(json);
}

// As `semfield view` is asked for pictures.
TEST(CameraOfARequest, WrongOnesAreNamed) {
  const auto refused = [](const std::string& json) {
    return error_of(ErrorKind::data, [&] { (void)read_request_camera(parse_request(json, {"camera"})["camera"]); });
  };
  const std::vector<std::pair<std::string, std::string>> rows{
      {R"({"camera":7})", "'camera': expected a map"},
      {R"({"camera":{"position":[0,0,0]}})", "'rotation' is missing"},
      {R"({"camera":{"position":[0,0],"rotation":[1,0,0,0,1,0,0,0,1]}})", "'position': expected 3 numbers"},
      {R"({"camera":{"position":[0,0,1e300],"rotation":[1,0,0,0,1,0,0,0,1]}})", "of a size that a scene"},
      {R"({"camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,0.9]}})", "is not a rotation"},
      {R"({"camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,-1]}})", "is not a rotation"},
      {R"({"camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1],"fov_deg":171}})", "degrees from 1"},
      {R"({"camera":{"position":[0,0,0],"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1]}})", "given twice"}};
  for (const auto& [json, words] : rows) EXPECT_HAS(refused(json), words) << json << "\n  " << refused(json);
  const FreeCamera camera = read_request_camera(parse_request(
      R"({"position":[1,2,3],"rotation":[0,-1,0,1,0,0,0,0,1],"fov_deg":90})", {"position", "rotation", "fov_deg"}));
  EXPECT_EQ(camera.world_from_camera.t.z, 3);
  EXPECT_EQ(camera.world_from_camera.r[0][1], -1);
  EXPECT_NEAR(camera.rays(64, 48).camera.fx, 32, 1e-9);
}

TEST(PictureRequestText, LabelsAreTheDefault) {
  const PictureRequest r = parse_picture_request(R"({"client":"c-1_","view":3})");
  EXPECT_EQ(r.view, 3);
  EXPECT_TRUE(r.labels);
  EXPECT_FALSE(r.color || r.entropy || r.full);
}

TEST_F(ServedPage, WrongRequestsForExportsAreRefused) {
  for (const char* bad : {"{}", R"({"what":"all"})", R"({"what":1})", R"({"what":"coco","to":"/etc"})", "null",
                          R"({"what":"coco","cancel":"coco-1"})", R"({"cancel":1})", R"({"cancel":"../x"})"})
    EXPECT_EQ(post("export", bad).status, 400) << bad;
}

TEST(QueryNumber, IsWholeAndBounded) {
  EXPECT_EQ(query_number("", "a", 7, 9), 7u);
  EXPECT_EQ(query_number("b=3&a=4", "a", 7, 9), 4u);
  EXPECT_EQ(query_number("aa=3", "a", 7, 9), 7u);
  for (const char* bad : {"a", "a=", "a=x", "a=-1", "a=10", "a=4.5", "a=4%20", "a=+4"})
    EXPECT_THROW((void)query_number(bad, "a", 7, 9), Error) << bad;
}

// Pictures as the page gets them: JPEG, and PNG of labels with transparency.

std::vector<std::uint8_t> decoded(const std::vector<std::uint8_t>& jpeg, int& width, int& height) {
  const tjhandle decoder = tjInitDecompress();
  int sampling = 0, space = 0;
  EXPECT_EQ(tjDecompressHeader3(decoder, jpeg.data(), jpeg.size(), &width, &height, &sampling, &space), 0);
  std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * width * height));
  EXPECT_EQ(tjDecompress2(decoder, jpeg.data(), jpeg.size(), rgb.data(), width, 0, height, TJPF_RGB, 0), 0);
  tjDestroy(decoder);
  return rgb;
}

TEST(Jpeg, APictureComesBackNearlyTheSame) {
  for (const auto& [w, h] : {std::pair{1, 1}, {33, 7}, {320, 240}}) {
    std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * w * h));
    for (int y = 0; y < h; ++y)
      for (int x = 0; x < w; ++x) {
        std::uint8_t* p = &rgb[3 * (y * w + x)];
        p[0] = static_cast<std::uint8_t>(255 * x / w);
        p[1] = static_cast<std::uint8_t>(255 * y / h);
        p[2] = 60;
      }
    int width = 0, height = 0;
    const std::vector<std::uint8_t> back = decoded(encode_jpeg(w, h, rgb), width, height);
    ASSERT_EQ(width, w);
    ASSERT_EQ(height, h);
    for (std::size_t i = 0; i < rgb.size(); ++i) ASSERT_NEAR(back[i], rgb[i], 24) << w << "x" << h << " at " << i;
  }
}

// Exports run a program beside the training: here a script that notes how it was called.

class Exports : public ServedPage {
 protected:
  // A program of these lines; --out is in $out.
  void serve_with(const std::string& lines) {
    const std::string program = folder_ + "/program";
    std::ofstream(program) << "#!/bin/sh\necho \"$@\" >" << folder_ << "/words\nnice >" << folder_
                           << "/nice\nwhile [ $# -gt 0 ]; do [ \"$1\" = --out ] && out=$2; shift; done\n"
                           << lines << "\n";
    chmod(program.c_str(), 0755);
    PageOptions o = options();
    o.exports = {program, folder_, {"waves.so"}};
    start(o);
  }
  // The list of exports once it is as wanted.
  Json list_when(const std::function<bool(const Json&)>& wanted) const {
    Json s = Json::parse(get("state?after=0").body);
    for (int i = 0; i < 200 && !wanted(s["exports"]); ++i)
      s = Json::parse(get("state?after=" + s["revision"].dump()).body);
    EXPECT_TRUE(wanted(s["exports"])) << s["exports"];
    return s["exports"];
  }
  // The first export in the list once it is made or has failed.
  Json ended() const {
    return list_when([](const Json& all) { return all[0]["state"] != "running" && all[0]["state"] != "waiting"; })[0];
  }
};

TEST_F(Exports, LabelsAreRenderedWithLowPriorityAndZipped) {
  serve_with(
      "echo one >$out/a_label.png; echo two >$out/b_label.png; echo no >$out/a_rgb.png; echo chair >$out/classes.yaml");
  const Answer begun = post("export", R"({"what":"labels"})");
  ASSERT_EQ(begun.status, 200) << begun.body;
  EXPECT_EQ(Json::parse(begun.body)["id"], "labels-1");
  const Json done = ended();
  EXPECT_EQ(done["state"], "done") << done;
  EXPECT_EQ(done["files"], Json{"labels.zip"});
  EXPECT_EQ(source_.saves, 1);
  EXPECT_EQ(read_text_file(folder_ + "/words"), "labels export " + folder_ + " --split train --format png --out " +
                                                    folder_ + "/export/labels-1 --plugin waves.so\n");
  EXPECT_EQ(read_text_file(folder_ + "/nice"), "10\n");
  const Answer file = get("export/labels-1/0");
  EXPECT_EQ(file.status, 200);
  EXPECT_EQ(file.header("content-disposition"), "attachment; filename=\"labels.zip\"");
  std::vector<std::string> names;
  for (const ZipEntry& entry : zip_entries(file.body)) names.push_back(entry.name);
  EXPECT_EQ(names, (std::vector<std::string>{"a_label.png", "b_label.png", "classes.yaml"}));
  EXPECT_HAS(zip_contents(file.body, zip_entries(file.body)[2]), "chair");
  for (const char* none : {"export/labels-1/1", "export/labels-1/-1", "export/labels-1/", "export/labels-1",
                           "export/labels-2/0", "export/../labels-1/0", "export//0", "export/labels-1/00000"})
    EXPECT_EQ(get(none).status, 404) << none;
}

TEST_F(Exports, CocoAndMeshesAreDownloaded) {
  serve_with(
      "case $out in *json) echo '{}' >$out;; *) echo ply >$out; echo glb >${out%ply}glb; echo cls "
      ">${out%.ply}_classes.glb;; esac");
  ASSERT_EQ(post("export", R"({"what":"mesh"})").status, 200);
  EXPECT_EQ(ended()["files"], (Json{"mesh.ply", "mesh.glb", "mesh_classes.ply", "mesh_classes.glb"}));
  EXPECT_EQ(get("export/mesh-1/1").body, "glb\n");
  EXPECT_EQ(get("export/mesh-1/3").body, "cls\n");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  list_when([](const Json& all) { return all[1]["state"] == "done"; });
  EXPECT_EQ(get("export/coco-1/0").body, "{}\n");
}

TEST_F(Exports, TwoAreMadeSideBySideAndTheOthersWaitForTheirTurn) {
  std::filesystem::create_directories(folder_ + "/export/coco-1");  // of an earlier session
  serve_with("until [ -e " + folder_ + "/go ]; do sleep 0.05; done; echo '{}' >$out");
  EXPECT_EQ(Json::parse(post("export", R"({"what":"coco"})").body)["id"], "coco-2")
      << "none takes the place of another";
  ASSERT_EQ(post("export", R"({"what":"mesh"})").status, 200);
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  const auto with_state = [](const Json& all, const char* state) {
    return std::count_if(all.begin(), all.end(), [&](const Json& e) { return e["state"] == state; });
  };
  list_when([&](const Json& all) { return with_state(all, "running") == 2 && with_state(all, "waiting") == 1; });
  for (int i = 0; i < 5; ++i) EXPECT_EQ(post("export", R"({"what":"coco"})").status, 200);
  const Answer ninth = post("export", R"({"what":"coco"})");
  EXPECT_EQ(ninth.status, 503);
  EXPECT_NE(Json::parse(ninth.body)["remedy"], "");
  std::ofstream(folder_ + "/go") << "";
  list_when([&](const Json& all) { return with_state(all, "done") == 8; });
}

TEST_F(Exports, OneThatIsMadeOrWaitsCanBeCanceled) {
  serve_with("echo $$ >>" + folder_ + "/pids; exec sleep 600");
  for (int i = 0; i < 3; ++i) ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  for (int i = 0;
       i < 500 && (!std::filesystem::exists(folder_ + "/pids") ||
                   read_text_file(folder_ + "/pids").find('\n') + 1 == read_text_file(folder_ + "/pids").size());
       ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  EXPECT_EQ(post("export", R"({"cancel":"coco-3"})").status, 200) << "waits";
  list_when([](const Json& all) { return all[2]["state"] == "canceled"; });
  EXPECT_EQ(post("export", R"({"cancel":"coco-1"})").status, 200);
  const Json all = list_when([](const Json& list) { return list[0]["state"] == "canceled"; });
  EXPECT_EQ(all[1]["state"], "running");
  EXPECT_TRUE(all[0]["files"].empty());
  EXPECT_EQ(post("export", R"({"cancel":"coco-9"})").status, 400);
  EXPECT_EQ(post("export", R"({"cancel":"coco-1"})").status, 200) << "and again";
}

TEST_F(Exports, ProgressIsWhatTheProgramSaidLast) {
  serve_with("echo 'exported 1/9 frames, 0:08 left' >&2; echo 'exported 2/9 frames, 0:07 left' >&2; until [ -e " +
             folder_ + "/go ]; do sleep 0.05; done; echo '{}' >$out");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  list_when([](const Json& all) { return all[0]["text"] == "exported 2/9 frames, 0:07 left"; });
  std::ofstream(folder_ + "/go") << "";
  EXPECT_EQ(ended()["state"], "done");
}

TEST_F(Exports, AFailureSaysWhatTheProgramSaidAndWhereTheRestIs) {
  serve_with("echo 'semfield: no room; free some' >&2; exit 74");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  const Json failed = ended();
  EXPECT_EQ(failed["state"], "failed");
  EXPECT_EQ(failed["text"], "exit code 74: semfield: no room; free some (see " + folder_ + "/export/coco-1/log.txt)");
  EXPECT_TRUE(failed["files"].empty());
  EXPECT_EQ(get("export/coco-1/0").status, 404);
}

TEST_F(Exports, ClosingEndsTheProgram) {
  serve_with("echo $$ >" + folder_ + "/pid; exec sleep 600");
  ASSERT_EQ(post("export", R"({"what":"coco"})").status, 200);
  for (int i = 0; i < 500 && !std::filesystem::exists(folder_ + "/pid"); ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  std::this_thread::sleep_for(std::chrono::milliseconds(50));
  const int pid = std::stoi(read_text_file(folder_ + "/pid"));
  server_.reset();
  EXPECT_NE(kill(pid, 0), 0);
}

// What the page's server refuses, and that no client can hold it up.

TEST_F(ServedPage, WithoutTheTokenThereIsNothing) {
  const std::string end = " HTTP/1.1\r\nHost: " + host() + "\r\n\r\n";
  std::string almost = token();
  almost.back() = 'b';
  for (const std::string& path :
       {std::string("/"), std::string("/state"), "/" + almost + "/state", "/" + token() + "b/state",
        "/" + token().substr(1) + "/state", "/x/" + token() + "/state", "//" + token() + "/state"}) {
    const Answer answer = ask("GET " + path + end);
    EXPECT_EQ(answer.status, 404) << path;
    EXPECT_EQ(answer.body, "not found\n") << path;
  }
}

TEST_F(ServedPage, TokensAreLongAndDiffer) {
  std::set<std::string> tokens;
  for (int i = 0; i < 100; ++i) tokens.insert(new_token());
  EXPECT_EQ(tokens.size(), 100u);
  for (const std::string& t : tokens) {
    EXPECT_EQ(t.size(), 32u);
    EXPECT_EQ(t.find_first_not_of("0123456789abcdef"), std::string::npos);
  }
}

TEST_F(ServedPage, ARunKeepsItsTokenForItsUserAlone) {
  const std::string token = kept_token(folder_), path = folder_ + "/serve_token";
  EXPECT_EQ(kept_token(folder_), token);
  EXPECT_EQ(std::filesystem::status(path).permissions(),
            std::filesystem::perms::owner_read | std::filesystem::perms::owner_write);
  std::filesystem::permissions(path, std::filesystem::perms::others_read, std::filesystem::perm_options::add);
  EXPECT_NE(kept_token(folder_), token);
}

TEST_F(ServedPage, AMovedRunKeepsItsIdAndACopyGetsItsOwn) {
  const std::string first = folder_ + "/first", moved = folder_ + "/moved", copied = folder_ + "/copied";
  fs::create_directory(first);
  const std::string id = kept_run_id(first), token = kept_token(first);
  EXPECT_EQ(id.size(), 32u);
  EXPECT_NE(id, token) << "a browser keeps the id, and the token is a secret";
  EXPECT_EQ(kept_run_id(first), id);
  fs::create_directory_symlink(first, folder_ + "/link");
  EXPECT_EQ(kept_run_id(folder_ + "/link"), id);
  fs::copy(first, copied, fs::copy_options::recursive);
  const std::string other = kept_run_id(copied);
  EXPECT_NE(other, id);
  EXPECT_NE(kept_token(copied), token) << "a page of the original would go on with the copy";
  EXPECT_EQ(kept_run_id(copied), other);
  EXPECT_EQ(kept_run_id(first), id);
  fs::rename(first, moved);
  EXPECT_EQ(kept_run_id(moved), id);
  EXPECT_EQ(kept_token(moved), token);
  // A new run of the old name is no other's copy.
  fs::create_directory(first);
  EXPECT_NE(kept_run_id(first), id);
  EXPECT_EQ(kept_run_id(moved), id);
  write_file_atomic(moved + "/run_id", "something else");
  EXPECT_NE(kept_run_id(moved), id);
}

TEST_F(ServedPage, AnotherHostIsRefused) {
  const auto with_host = [&](const std::string& lines) {
    return ask("GET /" + token() + "/state HTTP/1.1\r\n" + lines + "\r\n").status;
  };
  const std::string p = std::to_string(port());
  for (const std::string& good : {"127.0.0.1:" + p, "localhost:" + p, "LocalHost:" + p})
    EXPECT_EQ(with_host("Host: " + good + "\r\n"), 200) << good;
  for (const std::string& bad :
       {std::string("evil.example:") + p, std::string("127.0.0.1"), std::string("127.0.0.1:1"), "127.0.0.2:" + p,
        "127.0.0.1:" + p + "0", "localhost.evil.example:" + p, std::string("")})
    EXPECT_EQ(with_host("Host: " + bad + "\r\n"), 403) << bad;
  EXPECT_EQ(with_host(""), 403);
  EXPECT_EQ(with_host("Host: 127.0.0.1:" + p + "\r\nHost: evil.example\r\n"), 403);
}

TEST_F(ServedPage, AServerOfEveryAddressKnowsNumbersAlone) {
  PageOptions o = options();
  o.http.address = "0.0.0.0";
  start(o);
  const auto asked_as = [&](const std::string& name, int at) {
    return ask("GET /" + token() + "/ HTTP/1.1\r\nHost: " + name + ":" + std::to_string(at) + "\r\n\r\n").status;
  };
  EXPECT_EQ(asked_as("192.168.1.7", port()), 200);
  EXPECT_EQ(asked_as("localhost", port()), 200);
  EXPECT_EQ(asked_as("evil.example", port()), 403);
  EXPECT_EQ(asked_as("192.168.1.7", port() + 1), 403);
  EXPECT_EQ(server_->url(), "http://127.0.0.1:" + std::to_string(port()) + "/" + token() + "/");
}

TEST_F(ServedPage, PagesOfOthersMayNotSend) {
  const auto as = [&](const std::string& lines) { return ask(text("POST", "event", click("a-1"), lines)).status; };
  for (const char* bad : {"Origin: http://evil.example\r\n", "Origin: null\r\n", "Origin: http://127.0.0.1:1\r\n",
                          "Sec-Fetch-Site: cross-site\r\n", "Sec-Fetch-Site: same-site\r\n"})
    EXPECT_EQ(as(bad), 403) << bad;
  EXPECT_EQ(as("Origin: https://" + host() + "\r\n"), 403);
  EXPECT_EQ(as("Origin: http://localhost:" + std::to_string(port()) + "\r\n"), 403);  // not the one that was asked
  EXPECT_EQ(source_.events().size(), 0u);
  EXPECT_EQ(as("Origin: http://" + host() + "\r\nSec-Fetch-Site: same-origin\r\n"), 200);
}

TEST_F(ServedPage, PagesOfOthersMayLinkAndNothingElse) {
  const auto as = [&](const std::string& lines) { return ask(text("GET", "", "", lines)).status; };
  const std::string cross = "Sec-Fetch-Site: cross-site\r\n";
  EXPECT_EQ(as(cross), 403);
  EXPECT_EQ(as(cross + "Sec-Fetch-Mode: no-cors\r\nSec-Fetch-Dest: image\r\n"), 403);
  EXPECT_EQ(as(cross + "Sec-Fetch-Mode: navigate\r\nSec-Fetch-Dest: iframe\r\n"), 403);
  EXPECT_EQ(as(cross + "Sec-Fetch-Mode: navigate\r\nSec-Fetch-Dest: document\r\n"), 200);
}

TEST_F(ServedPage, LargeBodiesAreRefusedUnread) {
  const std::string large(300 << 10, ' ');
  EXPECT_EQ(post("event", large).status, 413);
  Connection promised(port());
  promised.send("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nContent-Length: 99999999999\r\n\r\n");
  EXPECT_EQ(promised.receive(5).status, 413);
  EXPECT_EQ(source_.events().size(), 0u);
}

TEST_F(ServedPage, ABodyWithoutALengthIsRefused) {
  for (const char* coding : {"chunked", "gzip, chunked", "identity"}) {
    Connection c(port());
    c.send("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nTransfer-Encoding: " + coding +
           "\r\n\r\n0\r\n\r\n" + text("POST", "event", click("a-1")));
    EXPECT_EQ(c.receive(5).status, 411) << coding;
    EXPECT_TRUE(c.closes(5)) << coding;
  }
  EXPECT_EQ(source_.events().size(), 0u);
}

// Whoever stands before the server might read another length, and what is behind the body then as a request.
TEST_F(ServedPage, ARequestWithTwoLengthsOrNoneThatIsANumberIsRefused) {
  const std::string body = click("a-1");
  const std::string size = std::to_string(body.size());
  for (const std::string& lengths : std::vector<std::string>{
           "Content-Length: " + size + "\r\nContent-Length: 6\r\n",
           "Content-Length: " + size + "\r\nContent-Length: " + size + "\r\n",
           "Content-Length: " + size + "\r\nTransfer-Encoding: chunked\r\n", "Content-Length: " + size + ", 37\r\n",
           "Content-Length: " + size + "," + size + "\r\n", "Content-Length: " + size + " 7\r\n",
           "Content-Length: +" + size + "\r\n", "Content-Length: -" + size + "\r\n", "Content-Length: 0x9\r\n",
           "Content-Length: " + size + ".0\r\n", "Content-Length: " + size + "a\r\n",
           std::string("Content-Length: \r\n"), "Content-Length : " + size + "\r\n",
           "X: y\r\n Content-Length: " + size + "\r\n", "Content-Length: " + size + "\x0b\r\n"}) {
    Connection c(port());
    c.send("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\n" + lengths + "\r\n" + body);
    EXPECT_EQ(c.receive(5).status, 400) << lengths;
    EXPECT_TRUE(c.closes(5)) << lengths;
  }
  EXPECT_EQ(source_.events().size(), 0u);
}

TEST_F(ServedPage, ARequestMayComeInPiecesAndWhatIsBehindItIsDropped) {
  Connection slow(port());
  for (const char byte : text("POST", "event", click("p-0"))) ASSERT_TRUE(slow.send(std::string(1, byte)));
  EXPECT_EQ(slow.receive().status, 200);
  Connection eager(port());
  ASSERT_TRUE(eager.send(text("POST", "event", click("p-1")) + text("POST", "event", click("p-2"))));
  EXPECT_EQ(eager.receive().status, 200);
  EXPECT_TRUE(eager.closes(5));
  EXPECT_EQ(source_.events().size(), 2u);
}

TEST_F(ServedPage, AHeadAloneHasNoBody) {
  Connection c(port()), other(port());
  for (Connection* head : {&c, &other}) head->send(text("HEAD", ""));
  EXPECT_EQ(c.receive_head(5).status, 405);
  EXPECT_EQ(other.receive(5).status, 0) << "the body never comes";
}

TEST_F(ServedPage, LongHeadsAreCutOff) {
  Connection c(port());
  c.send("GET /" + token() + "/ HTTP/1.1\r\nHost: " + host() + "\r\nX: ");
  for (int i = 0; i < 100 && c.send(std::string(1 << 16, 'z')); ++i) {
  }
  EXPECT_TRUE(c.closes(10));
}

TEST_F(ServedPage, ClientsThatSendAByteAtATimeAreCutOffWhileOthersAreServed) {
  std::list<Connection> slow;
  for (int i = 0; i < 8; ++i) slow.emplace_back(port());  // half of the threads
  for (Connection& c : slow)
    c.send("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nContent-Length: 1000\r\n\r\n");
  bool cut = false;
  for (int i = 0; i < 60 && !cut; ++i) {
    cut = true;
    for (Connection& c : slow) cut = !c.send("x") && cut;
    EXPECT_EQ(get("").status, 200);
    std::this_thread::sleep_for(std::chrono::milliseconds(500));
  }
  EXPECT_TRUE(cut) << "still served after 30 s";
}

TEST_F(ServedPage, ClientsThatReadNothingAreCutOffWhileOthersAreServed) {
  PageOptions o = options();
  o.files["big.js"] = {"text/javascript", std::string(64 << 20, 'x')};
  o.http.head_ms = 2000;
  start(o);
  std::list<Connection> deaf;
  for (int i = 0; i < 8; ++i) deaf.emplace_back(port());
  for (Connection& c : deaf) c.send(text("GET", "big.js"));
  for (int i = 0; i < 20; ++i) EXPECT_EQ(get("").status, 200);
  std::this_thread::sleep_for(std::chrono::seconds(6));
  for (int i = 0; i < 12; ++i) deaf.emplace_back(port());  // more than the threads that would be left
  EXPECT_EQ(get("").status, 200);
}

// Far more than there are threads, and they are let be for a minute: a response that comes did not wait for them.
TEST_F(ServedPage, IdleAndHalfSentConnectionsHoldNobodyUp) {
  PageOptions o = options();
  o.http.responses = 4;
  o.http.head_ms = o.http.body_ms = 60'000;
  start(o);
  std::list<Connection> idle;
  for (int i = 0; i < 200; ++i) {
    idle.emplace_back(port());
    if (i % 4 == 1) idle.back().send("GET /");
    if (i % 4 == 2) idle.back().send(text("POST", "event", click("a-1")).substr(0, 200));
    if (i % 4 == 3) {  // open after its response
      idle.back().send(text("GET", ""));
      ASSERT_EQ(idle.back().receive(20).status, 200);
    }
  }
  for (int i = 0; i < 5; ++i) {
    Connection c(port());
    c.send(text("GET", ""));
    EXPECT_EQ(c.receive(20).status, 200);
  }
}

TEST_F(ServedPage, WithTooManyConnectionsTheOneThatHasSaidNothingForTheLongestGoes) {
  PageOptions o = options();
  o.http.connections = 20;
  o.http.head_ms = 60'000;
  start(o);
  std::list<Connection> idle;
  for (int i = 0; i < 20; ++i) idle.emplace_back(port());
  EXPECT_EQ(get("").status, 200);
  EXPECT_TRUE(idle.front().closes(20));
  idle.back().send(text("GET", ""));
  EXPECT_EQ(idle.back().receive(20).status, 200);
}

TEST_F(ServedPage, PicturesThatNobodyWaitsForAnyMoreAreGivenUp) {
  source_.hold(true);
  {
    std::list<Connection> leaves;
    for (int i = 0; i < 40; ++i) {  // more than there are threads
      leaves.emplace_back(port());
      leaves.back().send(text("POST", "picture", R"({"client":"c)" + std::to_string(i) + R"(","view":0})"));
    }
    source_.wait_for_requests(16);
  }
  EXPECT_EQ(get("").status, 200);
  for (int i = 0; i < 1000 && source_.abandoned_pictures < 16; ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  EXPECT_GE(source_.abandoned_pictures, 16);
}

TEST_F(ServedPage, WhoWaitsForNewsLeavesThreadsToTheOthers) {
  PageOptions o = options();
  o.http.responses = 4;
  o.longest_poll_ms = 60'000;
  start(o);
  std::list<Connection> waiting;
  for (int i = 0; i < 40; ++i) {
    waiting.emplace_back(port());
    waiting.back().send(text("GET", "state?after=5"));
  }
  Connection c(port());
  c.send(text("GET", ""));
  EXPECT_EQ(c.receive(20).status, 200);
}

TEST_F(ServedPage, OddPathsAndHeadsLeaveTheServerAnswering) {
  const std::vector<std::string> odd{
      "GET / HTTP/1.1\r\n\r\n",
      "GET  HTTP/1.1\r\n\r\n",
      "GET /" + token() + "/" + std::string(15000, 'a') + " HTTP/1.1\r\nHost: " + host() + "\r\n\r\n",
      "GET /" + std::string(8000, '/') + " HTTP/1.1\r\nHost: " + host() + "\r\n\r\n",
      "GET /" + token() + "/" + std::string(3000, '.') + std::string(3000, '/') + " HTTP/1.1\r\nHost: " + host() +
          "\r\n\r\n",
      "GET /%%%%%%%%00%ff%f HTTP/1.1\r\nHost: " + host() + "\r\n\r\n",
      "GET http://evil.example/" + token() + "/ HTTP/1.1\r\nHost: " + host() + "\r\n\r\n",
      "GET * HTTP/1.1\r\nHost: " + host() + "\r\n\r\n",
      "GET /" + token() + "/ HTTP/9.9\r\nHost: " + host() + "\r\n\r\n",
      "GET /" + token() + "/ HTTP/1.1\nHost: " + host() + "\n\n",
      "POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nContent-Length: 99999999999999999999999\r\n\r\n",
      "GET /" + token() +
          "/ HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
          "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nHost: " +
          host() + "\r\n\r\n",
      std::string("\0\0\0\0\r\n\r\n", 8)};
  for (const std::string& request : odd) {
    Connection c(port());
    c.send(request);
    const Answer answer = c.receive(4);
    const int status = answer.status;
    EXPECT_NE(status, 101);
    if (status != 0) {
      EXPECT_EQ(answer.header("x-content-type-options"), "nosniff") << request.substr(0, 80);
    }
    EXPECT_NE(status, 500) << request.substr(0, 80);
    EXPECT_EQ(get("").status, 200) << request.substr(0, 80);
  }
  EXPECT_EQ(source_.events().size(), 0u);
}

TEST_F(ServedPage, ClosingAnswersRequestsThatWait) {
  Connection waiting(port());
  waiting.send(text("GET", "state?after=5"));
  std::this_thread::sleep_for(std::chrono::milliseconds(200));
  server_.reset();
  EXPECT_EQ(waiting.receive().status, 200);
}

TEST_F(ServedPage, ClosingGivesUpPicturesThatTakeLong) {
  source_.hold(true);  // for ever
  Connection waiting(port());
  waiting.send(text("POST", "picture", R"({"client":"c","view":0})"));
  source_.wait_for_requests(1);
  server_.reset();
  EXPECT_EQ(source_.abandoned_pictures, 1);
}

TEST_F(ServedPage, AddressesThatAreNoneAreNamed) {
  for (const auto& [address, kind] :
       {std::pair{"somewhere", ErrorKind::usage}, {"::1", ErrorKind::usage}, {"203.0.113.7", ErrorKind::unavailable}}) {
    HttpOptions http;
    http.address = address;
    EXPECT_HAS(error_of(kind, [&] { (void)listen_on(http); }), address) << address;
  }
}

}  // namespace
}  // namespace semfield::app
