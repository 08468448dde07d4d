
  const drakeOa = $readings;
  setInterval(() => {
    const time = viewer.animator ? viewer.animator.time : 0.0;
    let row = 0;
    while (row + 1 < drakeOa.length && drakeOa[row + 1][0] <= time + 1e-6) row += 1;
    drakeOaShow(drakeOa[row]);
  }, 50);