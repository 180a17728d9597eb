// What the page's server refuses, and that no client can hold it up.
#include <cstdio>
#include <future>
#include <random>
#include <set>

#include "app/serve/page_state.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/serve/served_page.h"

namespace semfield::app {
namespace {

using namespace testing_http;

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
  namespace fs = std::filesystem;
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
  const PageAccess access(token(), "0.0.0.0", 8787);
  const auto allowed = [&](const std::string& host) {
    return !access.refuse({"GET", "/" + token() + "/state", "", {{"host", host}}, ""}).has_value();
  };
  EXPECT_TRUE(allowed("192.168.1.7:8787"));
  EXPECT_TRUE(allowed("localhost:8787"));
  EXPECT_FALSE(allowed("evil.example:8787"));
  EXPECT_FALSE(allowed("192.168.1.7:8788"));
  EXPECT_EQ(access.url(), "http://127.0.0.1:8787/" + token() + "/");
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
  Connection chunks(port());
  chunks.send("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nTransfer-Encoding: chunked\r\n\r\n");
  for (int i = 0; i < 64 && chunks.send("2000\r\n" + std::string(0x2000, ' ') + "\r\n"); ++i) {
  }
  EXPECT_EQ(chunks.receive(5).status, 413);
  EXPECT_EQ(source_.events().size(), 0u);
}

TEST_F(ServedPage, ABodyInChunksIsRead) {
  const std::string body = click("a-1");
  char size[16];
  std::snprintf(size, sizeof size, "%zx", body.size());
  EXPECT_EQ(ask("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nTransfer-Encoding: chunked\r\n\r\n" +
                size + "\r\n" + body + "\r\n0\r\n\r\n")
                .status,
            200);
  EXPECT_EQ(source_.events().size(), 1u);
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
           "X: y\r\n Content-Length: " + size + "\r\n",
           "Transfer-Encoding: gzip, chunked\r\nX-Length: " + size + "\r\n", "Content-Length: " + size + "\x0b\r\n"}) {
    Connection c(port());
    c.send("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\n" + lengths + "\r\n" + body);
    EXPECT_EQ(c.receive(5).status, 400) << lengths;
    EXPECT_TRUE(c.closes(5)) << lengths;
  }
  EXPECT_EQ(source_.events().size(), 0u);
}

TEST_F(ServedPage, RequestsMayComeInPiecesAndSeveralAtOnce) {
  Connection slow(port());
  for (const char byte : text("POST", "event", click("p-0"))) ASSERT_TRUE(slow.send(std::string(1, byte)));
  EXPECT_EQ(slow.receive().status, 200);
  Connection eager(port());
  std::string many;
  for (int i = 1; i <= 50; ++i) many += text("POST", "event", click("p-" + std::to_string(i)));
  ASSERT_TRUE(eager.send(many + text("GET", "none") + text("GET", "", "", "Connection: close\r\n")));
  for (int i = 1; i <= 50; ++i) ASSERT_EQ(eager.receive().status, 200) << i;
  EXPECT_EQ(eager.receive().status, 404);
  EXPECT_EQ(eager.receive().body, "<html></html>");
  EXPECT_TRUE(eager.closes(5));
  EXPECT_EQ(source_.events().size(), 51u);
}

TEST_F(ServedPage, AClientThatAsksWhetherItMaySendIsTold) {
  Connection c(port());
  const std::string body = click("a-1");
  c.send("POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() +
         "\r\nExpect: 100-continue\r\nContent-Length: " + std::to_string(body.size()) + "\r\n\r\n");
  EXPECT_EQ(c.receive(5).status, 100);
  c.send(body);
  EXPECT_EQ(c.receive(5).status, 200);
}

TEST_F(ServedPage, AHeadAloneHasNoBody) {
  Connection c(port());
  c.send(text("HEAD", "") + text("GET", ""));
  EXPECT_EQ(c.receive_head(5).status, 405);
  EXPECT_EQ(c.receive(5).body, "<html></html>");
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
  o.http.head_ms = 1000;
  start(o);
  std::list<Connection> deaf;
  for (int i = 0; i < 8; ++i) deaf.emplace_back(port());
  for (Connection& c : deaf) c.send(text("GET", "big.js"));
  for (int i = 0; i < 20; ++i) EXPECT_EQ(get("").status, 200);
  std::this_thread::sleep_for(std::chrono::seconds(4));
  for (int i = 0; i < 12; ++i) deaf.emplace_back(port());  // more than the threads that would be left
  EXPECT_EQ(get("").status, 200);
}

// Far more than there are threads, and they are let be for a minute: a response that comes did not wait for them.
TEST_F(ServedPage, IdleAndHalfSentConnectionsHoldNobodyUp) {
  PageOptions o = options();
  o.http.threads = 4;
  o.http.head_ms = o.http.body_ms = 60'000;
  start(o);
  std::list<Connection> idle;
  for (int i = 0; i < 200; ++i) {
    idle.emplace_back(port());
    if (i % 4 == 1) idle.back().send("GET /");
    if (i % 4 == 2) idle.back().send(text("POST", "event", click("a-1")).substr(0, 200));
    if (i % 4 == 3) {  // kept after a response
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

TEST_F(ServedPage, WithTooManyConnectionsTheOneThatIsIdleTheLongestGoes) {
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
  o.http.threads = 4;
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

TEST_F(ServedPage, TenThousandMalformedMessagesLeaveTheSourceUntouched) {
  std::mt19937 random(7);
  const std::string good_event = click("a-1"), good_picture = R"({"client":"c","view":0,"labels":true})",
                    good_export = R"({"what":"coco"})";
  int sent = 0;
  const auto below = [&](std::size_t n) { return static_cast<std::size_t>(random()) % n; };
  while (sent < 10000) {
    Connection c(port());
    for (int on_one = 0; on_one < 50 && sent < 10000; ++on_one, ++sent) {
      const std::size_t kind = below(4);
      std::string bytes;
      if (kind == 0) {  // anything at all, as a head
        for (std::size_t i = 1 + below(200); i > 0; --i) bytes += static_cast<char>(random());
        bytes += "\r\n\r\n";
        c.send(bytes);
        break;
      }
      // A good body with bytes changed, cut or doubled, so that it is no good one any more.
      const std::string& whole = kind == 1 ? good_event : kind == 2 ? good_picture : good_export;
      std::string body = whole;
      for (std::size_t i = 1 + below(4); i > 0; --i) {
        const std::size_t at = below(body.size());
        switch (below(3)) {
          case 0:
            body[at] = static_cast<char>(random());
            break;
          case 1:
            body.resize(at + 1);
            break;
          default:
            body.insert(at, body.substr(at));
        }
      }
      body += '!';  // never JSON
      c.send(text("POST", kind == 1 ? "event" : kind == 2 ? "picture" : "export", body));
      const Answer answer = c.receive();
      ASSERT_TRUE(answer.status == 400 || answer.status == 413) << answer.status << " for " << body;
    }
  }
  EXPECT_EQ(source_.events().size(), 0u);
  EXPECT_TRUE(source_.requests.empty());
  EXPECT_EQ(source_.saves, 0);
  EXPECT_EQ(source_.state()->revision, 5u);
  EXPECT_EQ(post("event", good_event).status, 200);
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
      "POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nContent-Length: -1\r\n\r\n",
      "POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nContent-Length: 99999999999999999999999\r\n\r\n",
      "POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() + "\r\nTransfer-Encoding: chunked\r\n\r\nzzzz\r\n",
      "POST /" + token() + "/event HTTP/1.1\r\nHost: " + host() +
          "\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffff\r\n",
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

TEST_F(ServedPage, APortThatIsTakenIsNamedOrTheNextIsUsed) {
  PageOptions o = options();
  o.http.port = port();
  FakeSource other;
  try {
    const PageServer second(other, o);
    FAIL() << "two servers on one port";
  } catch (const Error& e) {
    EXPECT_EQ(e.kind(), ErrorKind::unavailable);
    EXPECT_EQ(e.message(), "port " + std::to_string(port()) + " of 127.0.0.1 is taken by another program");
    EXPECT_NE(e.remedy(), "");
  }
  o.next_port = true;
  const PageServer second(other, o);
  EXPECT_GT(second.port(), port());
}

TEST_F(ServedPage, AddressesThatAreNoneAreNamed) {
  for (const auto& [address, kind] :
       {std::pair{"somewhere", ErrorKind::usage}, {"::1", ErrorKind::usage}, {"203.0.113.7", ErrorKind::unavailable}}) {
    EXPECT_HAS(error_of(kind, [&] { (void)free_port(address, 8787, true); }), address) << address;
  }
}

}  // namespace
}  // namespace semfield::app
