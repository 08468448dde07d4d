
  let drakeOaAsked = 0;
  function drakeOaAsk(now) {
    requestAnimationFrame(drakeOaAsk);
    if (now < drakeOaAsked) return;
    drakeOaAsked = now + 2000;  // Timeout of the answer.
    const frame = viewer.scene_tree.children["drake_oa_frame"];
    const drawn = frame ? frame.object.renderOrder : 0;
    fetch(`${location.origin}/reading/${drawn}`).then((answer) => answer.json())
      .then(drakeOaShow).then(() => drakeOaAsked = now + 30, () => {});
  }
  requestAnimationFrame(drakeOaAsk);
  function drakeOaHidden() {
    // A hidden or closed page draws no frames: report all as drawn, so that the server continues.
    if (document.hidden) fetch(`${location.origin}/reading/Infinity`, {keepalive: true});
  }
  document.addEventListener("visibilitychange", drakeOaHidden);
  drakeOaHidden();